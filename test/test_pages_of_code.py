# SPDX-License-Identifier: Apache-2.0
"""Pages and benchmarks that follow the code: functions, effects, output, messages and imports."""

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from printed import agree

from smp_motor_ident.chain.catalogue import ALL
from smp_motor_ident.result import UNITS

ROOT = Path(__file__).resolve().parents[1]
PLAIN = {"first_order", "second_order", "electromechanical", "friction", "speed", "angle",
         "current"}  # fmt: skip


def page(name: str) -> str:
    (path,) = (p for p in ROOT.glob(f"docs/**/{name}") if not {"_build", "benchmarks"} & {*p.parts})
    return path.read_text(encoding="utf-8")


def find_fences(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def find_definitions(file: str) -> set[str]:
    """Return the functions, methods and classes that a file defines."""
    tree = ast.parse((ROOT / "smp_motor_ident" / file).read_text(encoding="utf-8"))
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    return {node.name for node in ast.walk(tree) if isinstance(node, kinds)}


def read_drawn_functions() -> list[tuple[str, str]]:
    """Return functions and files of the drawings, in their order."""
    lines = "".join(find_fences(page("record.md"), "text")).splitlines()
    rows = [re.search(r"([a-zA-Z_, ]+?) {2,}([\w/]+\.py)", line) for line in lines]
    return [(name, row[2]) for row in rows if row for name in row[1].strip().split(", ")]


def test_every_function_of_the_drawings_is_in_its_file():
    assert len(read_drawn_functions()) > 50
    for name, file in read_drawn_functions():
        assert name in find_definitions(file), f"{file} has no {name}"


def test_types_of_the_page_are_in_their_files():
    rows = re.findall(r"^\| `(\w+)` \| `([\w/]+\.py)` \|", page("record.md"), re.MULTILINE)
    assert len(rows) == 11
    for name, file in rows:
        assert name in find_definitions(file), f"{file} has no {name}"


def test_functions_are_drawn_in_the_order_in_which_they_are_called():
    text = (ROOT / "smp_motor_ident/estimate.py").read_text(encoding="utf-8")
    body = text[text.index("    group = [records]") :]
    order = [
        "check_request", "repair_records", "screen_records", "find_excitation", "prepare",
        "_fit_best_chain",
        "detect_levels", "collect_contributions", "state_quantities", "compute_fit_percents",
        "check_residuals", "refuse_unexplained", "collect_findings",
        "describe_provenance",
    ]  # fmt: skip
    called = [body.index(f"{name}(") for name in order]
    assert called == sorted(called)
    names = [name for name, _ in read_drawn_functions()]
    drawn_at = [names.index(name) for name in order]
    assert drawn_at == sorted(drawn_at)


def test_table_of_effects_lists_the_whole_catalogue():
    rows = page("identification.md").split("## Effects that are found")[1].splitlines()
    cells = [line.split("|") for line in rows if line.startswith("| `")]
    codes = [code for row in cells for code in re.findall(r"`(\w+)`", row[1])]
    assert sorted(codes) == sorted({one.code for one in ALL} - PLAIN)
    sizes = [name for row in cells for name in re.findall(r"`(\w+)`", row[3])]
    assert set(sizes) <= set(UNITS)


def test_example_program_prints_the_documented_output(capsys):
    text = page("identification.md")
    (program,) = find_fences(text, "python")
    (printed,) = find_fences(text, "text")
    shown = printed.splitlines()
    exec(compile(program, "identification", "exec"), {})
    fresh = capsys.readouterr().out.splitlines()
    assert [a for a, b in zip(shown, fresh, strict=True) if not agree(a, b)] == []


PAGE = (ROOT / "docs" / "messages.md").read_text()
MESSAGES = re.findall("^- (.*)", PAGE, re.MULTILINE)

FAULTS = {
    "longer than 260 characters": r".{261}",
    "more than two sentences": r"[.?] [A-Z].*[.?] [A-Z]",
    # In words: "resistance", "DC gain"; names to type, such as parameters, keep their underscores.
    "a quantity in code": r"(?<!\.)\b(dc_gain|time_constant|static_voltage|\w+_friction)\b",
    "a number without unit": r"\b(at|about|for|in|every|within|reaches) N(?! [A-Za-z%…])",
    "a percent sign without a space": r"[N\d]%",
    "an obscure phrase": r"\b(what (is|the|it)|of which|beside|is none|are no|(?<!there )is no)\b",
}  # fmt: skip


def test_messages_page_matches_the_code():
    script = [sys.executable, ROOT / "scripts" / "messages.py"]
    made = subprocess.run(script, capture_output=True, text=True, check=True).stdout
    assert made == PAGE, "python scripts/messages.py > docs/messages.md"


@pytest.mark.parametrize("fault", FAULTS)
def test_no_message_has_style_fault(fault):
    assert len(MESSAGES) > 400
    assert [one for one in MESSAGES if re.search(FAULTS[fault], one)] == []


FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
SCRIPTS = sorted(FOLDER.glob("*.py"))


def list_imports(path: Path) -> Iterator[tuple[str, str]]:
    """Yield module and name of every import of a script, those within functions too."""
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            yield from ((each.name, "") for each in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, each.name) for each in node.names)


def list_definitions(path: Path) -> set[str]:
    """Return the names that a script binds at its top level."""
    names = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            names |= {(each.asname or each.name).split(".")[0] for each in node.names}
        else:
            names |= {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
    return names


def exists(module: str, name: str) -> bool:
    """Tell whether a module of the project, or a script of the folder, has a name."""
    script = FOLDER / f"{module}.py"
    if script.exists():
        return not name or name in list_definitions(script)
    found = importlib.import_module(module)
    if not name or hasattr(found, name):
        return True
    try:
        importlib.import_module(f"{module}.{name}")
    except ImportError:
        return False
    return True


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_benchmarks_import_only_existing_public_names(path):
    ours = {script.stem for script in SCRIPTS}
    for module, name in list_imports(path):
        if module in ours or module.startswith("smp_"):
            assert not name.startswith("_"), f"{module}.{name} is private"
            assert exists(module, name), f"{module} has no {name}"

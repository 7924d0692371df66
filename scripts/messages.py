# SPDX-License-Identifier: Apache-2.0
"""Print the messages of tools and nodes as a page: ``python scripts/messages.py``."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CALLS = {"Finding", "note", "_damage", "report", "tell", "warning", "error", "info", "refuse"}
STATES = {"State", "Fault"}
"""Enumerations whose values are messages."""
TELLS = re.compile("_?(describe|report|problem|wrong|assess|name_cause)")
"""Functions that return a message."""
HEAD = """# Error and diagnostic messages

Messages of tools and nodes by package, printed by `python scripts/messages.py`. `N` stands for a
number, `…` for a word. The advice of a finding has a line of its own.
"""


def read_text(node: ast.expr) -> str:
    """Return a string with N or … for its placeholders, empty for other expressions."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.FormattedValue):
        form = ast.unparse(node.format_spec) if node.format_spec else ""
        formatted = ast.unparse(node.value).startswith("format_figure")
        number = formatted or form.endswith(("g'", "f'"))
        return "N%" if form.endswith("%'") else "N" if number else "…"
    return "".join(map(read_text, node.values)) if isinstance(node, ast.JoinedStr) else ""


def read_messages(path: Path) -> Iterator[str]:
    """Yield the messages in a module: texts of errors, findings, diagnostics and logs."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        texts: list[ast.expr] = []
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func).rpartition(".")[2]
            texts = node.args if name in CALLS or name.endswith("Error") else []
        elif isinstance(node, ast.Assign):
            name = ast.unparse(node.targets[0])
            told = name in ("text", "message", "advice") or name.endswith("_TEXT")
            texts = [node.value] if told else []
        elif isinstance(node, ast.ClassDef) and node.name in STATES:
            texts = [one.value for one in node.body if isinstance(one, ast.Assign)]
        elif isinstance(node, ast.FunctionDef) and TELLS.match(node.name):
            for part in ast.walk(node):
                if isinstance(part, ast.Return) and part.value is not None:
                    texts += part.value.elts if isinstance(part.value, ast.Tuple) else [part.value]
        for text in map(read_text, texts):
            if len(re.findall(r"[a-z]{2,}", text)) > 2 and " " in text:
                yield " ".join(text.split())


def page() -> str:
    """Return all messages as a page of Markdown."""
    found: dict[str, set[str]] = {}
    for path in sorted(ROOT.glob("smp_motor_*/**/*.py")):
        package = "/".join(path.relative_to(ROOT).parts[:2]).removesuffix(".py")
        found.setdefault(package, set()).update(read_messages(path))
    lines = [HEAD]
    for package, texts in filter(lambda item: item[1], found.items()):
        lines += [f"## {package}", "", "```text", *(f"- {one}" for one in sorted(texts)), "```", ""]
    return "\n".join(lines)


if __name__ == "__main__":
    print(page(), end="")

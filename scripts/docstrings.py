# SPDX-License-Identifier: Apache-2.0
"""Check the sections of docstrings with numpydoc's validator, as [tool.numpydoc_validation] says.

Sections are for the public API (`PUBLIC` and docstrings that have one); elsewhere a line suffices.
A function without arguments whose summary states its result (a property, or ``"Return the ..."``)
needs no Returns section. Nested functions are exempt.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

from numpydoc.hooks.validate_docstrings import parse_config, process_file

PUBLIC = {
    *("estimate", "design", "read_records"),
    *("Pid", "PidGains", "Motor", "MotorParameters", "SkidSteer"),
}
SECTIONS = ("Parameters\n", "Returns\n", "Yields\n")


def has_sections(node: ast.FunctionDef | ast.ClassDef) -> bool:
    """Return whether a function or class is documented in sections."""
    doc = ast.get_docstring(node) or ""
    return node.name in PUBLIC or any(section + "-" * 5 in doc for section in SECTIONS)


def says_what_it_returns(node: ast.FunctionDef) -> bool:
    """Return whether the summary line replaces a Returns section."""
    decorators = {ast.unparse(decorator) for decorator in node.decorator_list}
    if decorators & {"property", "cached_property", "functools.cached_property"}:
        return True
    arguments = node.args
    count = len(arguments.posonlyargs + arguments.args + arguments.kwonlyargs)
    alone = count == 0 or (count == 1 and arguments.args[0].arg in ("self", "cls"))
    return alone and (ast.get_docstring(node) or "").startswith("Return")


def main(files: list[str]) -> int:
    """Print the findings; return 1 if there are any."""
    config = parse_config(Path(__file__).parent.parent)
    findings = 0
    for file in files:
        tree = ast.parse(Path(file).read_text(encoding="utf-8"))
        functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
        classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
        brief = {node.lineno for node in functions if not has_sections(node)}
        brief |= {node.lineno for node in classes if not has_sections(node)}
        mild = {node.lineno for node in functions if says_what_it_returns(node)}
        inside = {node for outer in functions for node in ast.walk(outer) if node is not outer}
        inner = {node.lineno for node in inside if isinstance(node, ast.FunctionDef)}
        for place, name, check, description in process_file(file, config):
            line = int(place.rpartition(":")[2])
            if line in inner or (line in brief and check != "GL08"):
                continue
            if check == "RT01" and line in mild:
                continue
            print(f"{place}: {name}: {check} {description}")
            findings += 1
    return int(findings > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

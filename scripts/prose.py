# SPDX-License-Identifier: Apache-2.0
"""Limit obscure phrases in comments, docstrings and pages: ``python scripts/prose.py``."""

import ast
import re
import subprocess
import sys
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

VERBS = "is|are|was|were|may|has|have|had|shows?|moves?|drives?|lacks?"
RULES = {  # largest rate per 1,000 words: twice that of lmfit, statsmodels and similar projects
    rf"what (?:{VERBS}|the|a|an|it|its|they|one|no|nobody)": 0.6,
    "(?:of|by|beside|behind|with) (?:which|what)": 0.4,
    "beside": 0.2,
    "by how much|as (?:good|little|few|surely|much|far) as": 0.4,
    "(?:is|are|was) none|that (?:is|are) no": 0.2,
    "hangs? (?:on|together)|stands? (?:in|for|on|there|still)|take[ns]? of": 0.3,
}


def read_prose(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of docstrings and comments, or of a page without its code."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        text = re.sub(r"```.*?```", lambda code: "\n" * code[0].count("\n"), text, flags=re.DOTALL)
        yield 1, re.sub(r"`[^`]*`", "", text)
        return
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            yield getattr(node, "lineno", 1), ast.get_docstring(node) or ""
    with path.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type == tokenize.COMMENT:
                yield token.start[0], token.string


def main() -> int:
    """Print the occurrences of phrases that are too frequent; return 1 if there are any."""
    words: Counter[str] = Counter()
    found: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
    listed = subprocess.run(["git", "ls-files"], capture_output=True, text=True, check=True)
    for name in listed.stdout.splitlines():
        group = "product" if name.startswith("smp_motor_") else "tests, benchmarks and scripts"
        group = "pages" if name.endswith(".md") else group
        if not name.endswith((".py", ".md")) or "derivations" in name:
            continue
        for line, text in read_prose(Path(name)):
            words[group] += len(text.split())
            for rule in RULES:
                for hit in re.finditer(rf"\b(?:{rule})\b", text, re.IGNORECASE):
                    at = line + text[: hit.start()].count("\n")
                    found[group, rule].append(f"{name}:{at}: {hit[0]!r}")
    failed = 0
    for (group, rule), places in found.items():
        if (rate := 1000 * len(places) / words[group]) > RULES[rule]:
            print(*places, f"{group}: {rate:.2f} per 1,000 words, at most {RULES[rule]}", sep="\n")
            failed = 1
    return failed


if __name__ == "__main__":
    sys.exit(main())

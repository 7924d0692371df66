# SPDX-License-Identifier: Apache-2.0
"""Run the tests of safety-critical modules on mutants, and list the survivors.

    python benchmarks/mutation.py                       # every module of the table, some hours
    python benchmarks/mutation.py pid wheel.faults      # these
    python benchmarks/mutation.py --sample 40 --seed 1  # so many mutants of each, drawn at random

A mutant is the module with one comparison, operator, number, condition or statement changed.  The
tests of the module are collected once; for every mutant they run in a copy of that process, with
its code in the place of the module's, until one fails or five times their usual time is over.
Files stay as they are.  Messages, annotations, decorators and texts are left alone.  Survivors are
printed; those that no test can notice stand with the reason in
docs/decisions/mutants-that-live.md.
Exit code 1 below 85 % in any module.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import resource
import signal
import struct
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType, ModuleType

import pytest
from _pytest.runner import runtestprotocol
from hypothesis import Phase, settings

ROOT = Path(__file__).resolve().parents[1]
LEAST = 0.85
CONTROL, BAG = "smp_motor_control.", "smp_motor_ident.bag."
TESTS = {
    CONTROL + "pid": "control/test_pid_law.py control/test_pid_conformance.py",
    CONTROL + "encoder": "control/test_encoder.py",
    CONTROL + "wheel.freshness": "control/test_supervision.py",
    CONTROL + "wheel.faults": "control/test_fault_detector.py control/test_supervision.py",
    CONTROL + "wheel.lease": "control/test_supervision.py",
    CONTROL + "wheel.controller": "control/test_wheel_limits.py "
                                "control/test_fault_detector.py control/test_wheel_controller.py",
    CONTROL + "wheel.loop": "control/test_wheel_loop.py control/test_wheel_limits.py",
    CONTROL + "wheel.acceptance": "control/test_acceptance.py",
    CONTROL + "body.odometry": "control/test_odometry.py",
    CONTROL + "body.command": "control/test_diff_drive_conformance.py control/test_skid_steer.py",
    BAG + "counter": "ident/bag/test_counter.py",
    BAG + "salvage": "ident/bag/test_salvage.py",
    BAG + "unpack": "ident/bag/test_unpack.py",
}  # fmt: skip
"""Test files, the quickest first, by the module that they test."""

COMPARISONS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
}  # fmt: skip
OPERATORS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.LShift: ast.RShift,
    ast.RShift: ast.LShift, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
CALLS = {"min": "max", "max": "min"}


@dataclass(frozen=True)
class Mutant:
    """A change of a module: where, what, and how to make it in the tree it was found in."""

    line: int
    what: str
    change: Callable[[], object]


def mutants(tree: ast.Module) -> list[Mutant]:
    """Return every change of a tree; each may be made in a copy of this process only."""
    found: list[Mutant] = []
    for node in _code(tree):
        found += [Mutant(node.lineno, what, change) for what, change in _changes(node)]
    return found


def _code(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """Yield the nodes that compute something, with their blocks."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, (ast.Raise, ast.JoinedStr, ast.Assert, ast.Import)):
                if isinstance(child, ast.Raise):
                    yield child
                continue
            if isinstance(child, (ast.expr, ast.stmt)):
                yield child
            if isinstance(child, ast.AST):
                yield from _code(child)


def _changes(node: ast.expr | ast.stmt) -> Iterator[tuple[str, Callable[[], object]]]:
    text = ast.unparse(node).splitlines()[0]
    put = lambda name, value: lambda: setattr(node, name, value)  # noqa: E731
    match node:
        case ast.Compare(ops=ops):
            for k, op in enumerate(ops):
                for other in COMPARISONS[type(op)]:
                    change = lambda k=k, other=other: ops.__setitem__(k, other())  # noqa: E731
                    yield f"{text}: {type(op).__name__} {other.__name__}", change
        case ast.BinOp(op=op) | ast.BoolOp(op=op) | ast.AugAssign(op=op):
            other = OPERATORS[type(op)]
            yield f"{text}: {type(op).__name__} {other.__name__}", put("op", other())
        case ast.UnaryOp(op=ast.Not() | ast.USub()) if not isinstance(node.operand, ast.Constant):
            yield f"{text}: without {type(node.op).__name__}", put("op", ast.UAdd())
        case ast.Constant(value=bool() as value):
            yield f"{text}: {not value}", put("value", not value)
        case ast.Constant(value=int() | float() as value):
            new = value + 1 if isinstance(value, int) else 1.5 * value or 1.0
            yield f"{text}: {new}", put("value", new)
        case ast.Call(func=ast.Name(id="min" | "max" as name) as function):
            yield f"{text}: {CALLS[name]}", lambda: setattr(function, "id", CALLS[name])
    if isinstance(node, (ast.If, ast.IfExp, ast.While)) and not isinstance(node.test, ast.Compare):
        yield f"{text}: not", put("test", ast.UnaryOp(ast.Not(), node.test))
    if _may_go(node):
        yield f"{text}: gone", lambda: setattr(node, "__class__", ast.Pass)
    nothing = isinstance(node, ast.Return) and (
        node.value is None or (isinstance(node.value, ast.Constant) and not node.value.value)
    )
    if isinstance(node, ast.Return) and not nothing:
        yield f"{text}: None", put("value", ast.Constant(None))


def _may_go(node: ast.AST) -> bool:
    match node:
        case ast.Expr(value=ast.Constant()):
            return False
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            return True
    return isinstance(node, (ast.Expr, ast.Raise, ast.AugAssign, ast.Continue, ast.Break))


class Campaign:
    """A pytest plugin: in the place of the tests' one run, one run for every mutant of a module."""

    def __init__(self, name: str, sample: int | None, draw: random.Random) -> None:
        self.name, self.sample, self.draw = name, sample, draw
        self.share = 0.0

    def pytest_collection(self) -> None:
        """Have hypothesis not search for the smallest failing example."""
        phases = [Phase.explicit, Phase.generate]
        settings.register_profile("mutants", settings.default, database=None, phases=phases)
        settings.load_profile("mutants")

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Run the collected tests once as they are, and once for every mutant."""
        name, items = self.name, list(session.items)
        path = ROOT / (name.replace(".", "/") + ".py")
        tree = ast.parse(path.read_text())
        every = mutants(tree)
        chosen = (
            every if self.sample is None else self.draw.sample(every, min(self.sample, len(every)))
        )
        begin = time.monotonic()
        if not items or run(items, lambda: None, 600.0) is not None:
            print(f"{name}: there are no tests, or they fail without a change")
            return True
        limit = 10.0 + 5.0 * (time.monotonic() - begin)
        lived = 0
        for mutant in sorted(chosen, key=lambda m: m.line):
            by = run(items, lambda m=mutant: _put(name, path, tree, m), limit)  # type: ignore[misc]
            if by is None:
                lived += 1
                print(f"  lives  {path.relative_to(ROOT)}:{mutant.line}: {mutant.what}", flush=True)
            else:
                items.insert(0, items.pop(by))  # who found one finds the next
        killed = len(chosen) - lived
        self.share = share = killed / max(len(chosen), 1)
        took = time.monotonic() - begin
        print(
            f"{name}: {killed} of {len(chosen)} mutants killed, {100 * share:.1f} %, {took:.0f} s"
        )
        return True


def run(items: list[pytest.Item], change: Callable[[], None], limit: float) -> int | None:
    """Run tests in a copy of this process; return the one that failed or hung, None if none did."""
    inlet, outlet = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            _silence()
            change()
            for k, item in enumerate(items):
                os.write(outlet, struct.pack("<i", k))
                if any(report.failed for report in runtestprotocol(item, log=False)):
                    os._exit(1)
            os._exit(0)
        finally:
            os._exit(2)
    os.close(outlet)
    status = _wait(child, limit)
    with os.fdopen(inlet, "rb") as pipe:
        begun = pipe.read()
    return max(len(begun) // 4 - 1, 0) if status else None


def _silence() -> None:
    os.setsid()
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
    nowhere = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1, 2):
        os.dup2(nowhere, number)


def _wait(child: int, limit: float) -> int:
    """Return how a process ended; one that takes too long is ended."""
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return status
        time.sleep(0.002)
    os.killpg(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1]


def _put(name: str, path: Path, tree: ast.Module, mutant: Mutant) -> None:
    """Give the functions and numbers of an imported module those of its mutant."""
    mutant.change()
    ast.fix_missing_locations(tree)
    new: dict[str, object] = {"__name__": name}
    module = ModuleType(name)
    module.__dict__.update(new)
    exec(compile(tree, str(path), "exec"), module.__dict__)
    _take_over(vars(sys.modules[name]), vars(module), name, sys.modules[name])


def _take_over(
    old: Mapping[str, object], new: Mapping[str, object], name: str, owner: object
) -> None:
    for key, value in list(old.items()):
        other = new.get(key)
        if isinstance(value, type) and value.__module__ == name and isinstance(other, type):
            _take_over(vars(value), vars(other), name, value)
        elif isinstance(value, property) and isinstance(other, property):
            _adopt(value.fget, other.fget)
        elif _is_number(value) and value != other:
            setattr(owner, key, other)
        else:
            _adopt(value, other)


def _adopt(old: object, new: object) -> None:
    """Give a function the code and the numbers among the defaults of another."""
    old, new = (getattr(f, "__func__", f) for f in (old, new))
    old, new = (getattr(f, "__wrapped__", f) for f in (old, new))
    if not (isinstance(old, FunctionType) and isinstance(new, FunctionType)):
        return
    old.__code__ = new.__code__
    pairs = zip(old.__defaults__ or (), new.__defaults__ or ())
    old.__defaults__ = tuple(n if _is_number(o) else o for o, n in pairs) or None
    named, others = old.__kwdefaults__ or {}, new.__kwdefaults__ or {}
    named.update({k: others[k] for k, v in named.items() if _is_number(v)})


def _is_number(value: object) -> bool:
    """Tell numbers, and collections of nothing but numbers."""
    if isinstance(value, (tuple, list, set, frozenset)):
        return all(map(_is_number, value))
    if isinstance(value, dict):
        return all(map(_is_number, value.values()))
    return type(value) in (int, float, bool)


def campaign(name: str, sample: int | None, seed: int) -> bool:
    """Judge the mutants of one module; return whether enough are killed."""
    plugin = Campaign(name, sample, random.Random(seed))
    files = [str(ROOT / "test" / file) for file in TESTS[name].split()]
    options = ["-s", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:terminal"]
    options += ["-o", "addopts=", "--import-mode=importlib"]
    where = [f"--rootdir={ROOT}", "-c", str(ROOT / "pyproject.toml")]
    pytest.main([*options, *where, *files], plugins=[plugin])
    return plugin.share >= LEAST


def main() -> int:
    """Run the campaign; exit code 1 where tests notice too little."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    known = {name.removeprefix(CONTROL).removeprefix("smp_motor_ident."): name for name in TESTS}
    parser.add_argument("modules", nargs="*", help=", ".join(known))
    parser.add_argument("--sample", type=int, metavar="N")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    if unknown := set(given.modules) - set(known):
        parser.error(f"{', '.join(sorted(unknown))}: known are {', '.join(known)}")
    sys.path.insert(0, str(ROOT))
    chosen = [known[name] for name in given.modules] or list(TESTS)
    held = [campaign(module, given.sample, given.seed) for module in chosen]
    return 0 if all(held) else 1


if __name__ == "__main__":
    sys.exit(main())

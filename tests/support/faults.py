"""Mutation testing: 28 faults of faults.toml, and 12 random ones.

    python tests/support/faults.py [--only NAME ...] [--drawn 12] [--seed 43]

Each is planted in a copy of the tree. The tests nearest to it run first, then all of ``make
test``, until one fails; the table says which. Drawn faults change a line of ``svu_mi/capture``,
``posterior``, ``output`` or ``batch`` that these tests execute, by six operators in turn.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import CodeType
from typing import Any

ROOT = Path(__file__).parents[2]
FAULTS = Path(__file__).with_suffix(".toml")
PACKAGES = ("capture", "posterior", "output", "batch")
OPERATORS = ("negate a condition", "drop a statement", "swap two arguments",
             "change a constant", "off by one", "widen a limit")  # fmt: skip
SPARE = 12  # sites of a drawn fault, of which the first that is executed is chosen
FAILED = re.compile(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", re.MULTILINE)


@dataclass(frozen=True)
class Fault:
    """A mistake: ``right`` becomes ``wrong`` where it stands once, or at offset ``start``.

    ``tests`` are the files nearest to it in ``tests``, separated by spaces.
    """

    name: str
    file: str
    tests: str
    right: str
    wrong: str
    start: int = -1
    line: int = 0

    def planted(self, text: str) -> str:
        """Return the text of the file with the fault in it, which is Python still."""
        if self.start < 0 and text.count(self.right) != 1:
            raise SystemExit(
                f"{self.name}: {self.right!r} stands in {self.file} {text.count(self.right)} "
                "times, not once; write the fault for what the file says now."
            )
        start = text.index(self.right) if self.start < 0 else self.start
        changed = text[:start] + self.wrong + text[start + len(self.right) :]
        compile(changed, self.file, "exec")
        return changed


# --- faults that are drawn ------------------------------------------------------------------


def mutants(node: ast.AST) -> Iterator[tuple[str, ast.AST, str]]:
    """Yield the operator, the node that is replaced and its new text."""
    match node:
        case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test):
            yield OPERATORS[0], test, f"(not ({ast.unparse(test)}))"
        case ast.AugAssign() | ast.Expr(value=ast.Call()):
            if not ast.unparse(node).startswith("dr."):  # when arrays are evaluated changes nothing
                yield OPERATORS[1], node, "pass"
        case ast.Call(args=[ast.expr() as first, ast.expr() as second, *rest]):
            if not re.search("min|max|add|einsum", ast.unparse(node.func)):  # else all the same
                swapped = ast.Call(node.func, [second, first, *rest], node.keywords)
                yield OPERATORS[2], node, ast.unparse(swapped)
        case ast.Constant(value=bool() | int() | float() as value):
            yield OPERATORS[3], node, repr(not value if isinstance(value, bool) else 2 * value or 1)
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=ast.Constant(value=1)):
            yield OPERATORS[4], node, ast.unparse(left)
        case ast.Compare(ops=[ast.Lt() | ast.LtE() | ast.Gt() | ast.GtE() as sign]):
            other = {"Lt": ast.LtE, "LtE": ast.Lt, "Gt": ast.GtE, "GtE": ast.Gt}
            if isinstance(limit := node.comparators[0], ast.Name) and limit.id.isupper():
                more = "*" if isinstance(sign, ast.Gt | ast.GtE) else "/"
                yield OPERATORS[5], limit, f"({limit.id} {more} 10)"
            elif re.search(r"len\(|[^.\d]\d+$|count|size", ast.unparse(node)):  # of whole numbers
                moved = ast.Compare(node.left, [other[type(sign).__name__]()], node.comparators)
                yield OPERATORS[4], node, ast.unparse(moved)


def sites(file: Path, operator: str) -> Iterator[Fault]:
    """Yield every fault of an operator in the functions of a file, without ``tests``."""
    text = file.read_text(encoding="utf-8")
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    functions = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef)]
    nodes = [one for function in functions for part in function.body for one in _inside(part)]
    for kind, node, wrong in (mutant for one in nodes for mutant in mutants(one)):
        right = ast.get_source_segment(text, node)  # type: ignore[arg-type]
        if kind == operator and right and text.isascii():
            start = starts[node.lineno - 1] + node.col_offset  # type: ignore[attr-defined]
            name = f"{operator}: {' '.join(right.split())[:40]}"
            path, line = str(file.relative_to(ROOT)), node.lineno  # type: ignore[attr-defined]
            yield Fault(name, path, "", right, wrong, start, line)


def _inside(node: ast.AST) -> Iterator[ast.AST]:
    """Walk a tree, but for annotations and the parts of strings, and functions in it."""
    yield node
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.JoinedStr | ast.FunctionDef | ast.arguments):
            yield from _inside(child)


def drawn(count: int, seed: int, tree: Path) -> tuple[list[Fault], list[str]]:
    """Draw faults in lines that tests execute; return them, and tests that fail without any."""
    chosen = []
    places = [sorted((ROOT / "svu_mi" / package).rglob("*.py")) for package in PACKAGES]
    for number in range(count):
        operator = OPERATORS[number % 6]
        spots = [fault for file in places[number % 4] for fault in sites(file, operator)]
        if len(spots) < SPARE:  # there are few: those of all packages
            spots = [fault for files in places for file in files for fault in sites(file, operator)]
        chosen.append(random.Random(f"{seed} {number}").sample(spots, min(SPARE, len(spots))))
    watched = [f"{fault.file}:{fault.line}" for some in chosen for fault in some]
    (tree / "watched.json").write_text(json.dumps(watched))
    broken = failures(tree, [], "-p", "support.faults", "--maxfail", "1000")
    ran: dict[str, set[str]] = {}
    for file in tree.glob("ran.*.json"):
        for place, tests in json.loads(file.read_text()).items():
            ran.setdefault(place, set()).update(tests)
    faults = []
    for some in chosen:
        for fault in [fault for fault in some if f"{fault.file}:{fault.line}" in ran][:1]:
            tests = ran[f"{fault.file}:{fault.line}"]
            shortest = sorted(tests, key=lambda name: (ROOT / "tests" / name).stat().st_size)
            faults.append(replace(fault, tests=" ".join(shortest[:4])))
    return faults, broken


class Watcher:
    """Plugin of pytest: records which files of tests execute the lines that are watched."""

    def __init__(self, places: list[str]) -> None:
        self.places, self.ran, self.now = set(places), dict[str, set[str]](), ""
        self.files = {place.rpartition(":")[0] for place in places}
        self.known: dict[CodeType, str] = {}
        sys.settrace(self.called)
        threading.settrace(self.called)

    def called(self, frame: Any, event: str, _: object) -> Any:
        code = frame.f_code
        if code not in self.known:
            path = os.path.relpath(code.co_filename)
            self.known[code] = path if path in self.files else ""
        path = self.known[code]
        if event == "line" and f"{path}:{frame.f_lineno}" in self.places:
            self.ran.setdefault(f"{path}:{frame.f_lineno}", set()).add(self.now)
        return self.called if path else None

    def pytest_runtest_setup(self, item: Any) -> None:
        self.now = str(item.path.relative_to(Path.cwd() / "tests"))

    def pytest_sessionfinish(self) -> None:
        kept = {place: sorted(tests) for place, tests in self.ran.items()}
        Path(f"ran.{os.getpid()}.json").write_text(json.dumps(kept))


def pytest_configure(config: Any) -> None:
    """Watch lines where this file is a plugin."""
    config.pluginmanager.register(Watcher(json.loads(Path("watched.json").read_text())))


def copied(tree: Path) -> None:
    """Copy the sources, but for what Git ignores."""
    listed = subprocess.check_output(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=ROOT
    )
    for name in filter(None, listed.decode().split("\0")):
        if (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            (tree / name).write_bytes((ROOT / name).read_bytes())


def failures(tree: Path, tests: list[str], *options: str) -> list[str]:
    """Return which of the fast tests fail, of all if none are named; the first one, by default."""
    kernels = os.environ.get("DRJIT_CACHE_DIR", str(ROOT / ".pytest_cache" / "drjit"))
    paths = os.pathsep.join([str(tree), str(tree / "tests")])
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-x", "-m", "not slow", "-n", "2", "--dist", "loadfile",
         *options, *(f"tests/{name}" for name in tests)],
        cwd=tree, env={**os.environ, "PYTHONPATH": paths, "DRJIT_CACHE_DIR": kernels},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    failed = FAILED.findall(run.stdout)
    return failed or ([] if run.returncode in (0, 5) else [(run.stdout + run.stderr)[-200:]])


def tried(fault: Fault, tree: Path, broken: list[str]) -> str:
    """Plant a fault; return the first test that notices it, or mypy, or nothing."""
    path = tree / fault.file
    text = path.read_text(encoding="utf-8")
    path.write_text(fault.planted(text), encoding="utf-8")
    but = [f"--deselect={name}" for name in broken]
    try:
        for tests in (fault.tests.split(), []):
            if noticed := failures(tree, tests, *but):
                return noticed[0]
        mypy = subprocess.run([sys.executable, "-m", "mypy"], cwd=tree, capture_output=True)
        return "mypy" if mypy.returncode else ""
    finally:
        path.write_text(text, encoding="utf-8")


def main() -> int:
    """Plant the faults one by one, print a table; return how many nothing has noticed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="parts of names of faults")
    parser.add_argument("--drawn", type=int, default=len(PACKAGES) * 3)
    parser.add_argument("--seed", type=int, default=43)
    asked = parser.parse_args()
    written = [Fault(**row) for row in tomllib.loads(FAULTS.read_text())["fault"]]
    for fault in written:
        fault.planted((ROOT / fault.file).read_text(encoding="utf-8"))  # refused before any work
    with tempfile.TemporaryDirectory(prefix="svu-faults-") as folder:
        tree, missed = Path(folder), 0
        copied(tree)
        more, broken = drawn(asked.drawn, asked.seed, tree) if asked.drawn else ([], [])
        if broken:
            print("These fail without any fault:", *broken, file=sys.stderr)
        print("| fault | file | caught by | seconds |\n|---|---|---|--:|", flush=True)
        for fault in (*written, *more):
            if not asked.only or any(part in fault.name for part in asked.only):
                start, noticed = time.perf_counter(), tried(fault, tree, broken)
                missed += not noticed
                print(f"| {fault.name} | `{fault.file}` {fault.line or ''} | "
                      f"{noticed or '**nothing**'} | {time.perf_counter() - start:.0f} |",
                      flush=True)  # fmt: skip
    return missed


if __name__ == "__main__":
    raise SystemExit(main())

"""Mutation testing: 28 faults of faults.toml, and random ones.

    python tests/support/faults.py [--only NAME ...] [--drawn 12] [--seed 43]
    python tests/support/faults.py --machinery [--drawn 60] [--seed 46] [--slow]

Each is planted in a copy of the tree. The tests nearest to it run first, then all of ``make
test``, until one fails; the table says which. Drawn faults change a line of ``ROOMS`` that these
tests execute, by six operators in turn.

``--machinery`` draws only, in input, files, records, viewer and batch, and also in lines that no
test executes. The tests of these rooms that execute the line run first, the shortest before, then
all of ``make test``; with ``--slow``, then the slow tests. Faults of ``equivalent`` in faults.toml
change nothing that a test could see, for the reason there.
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
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import CodeType
from typing import Any

ROOT = Path(__file__).parents[2]
FAULTS = Path(__file__).with_suffix(".toml")
ROOMS = (("capture",), ("posterior",), ("output",), ("cli/batch",))
MACHINERY = (
    ("capture",), ("core/io",), ("output/viewer",),
    ("cli/batch", "cli/loading.py", "cli/import_.py"),
    ("calibration/light/light_folder.py", "evaluation/reference_cache.py", "recovery/checkpoint.py",
     "output/run_record.py", "output/texture_files.py"),
)  # fmt: skip
NEAR = ("capture", "core", "robustness", "cli", "journeys", "calibration/test_light_folder.py",
        "recovery/test_checkpoint.py", "output/test_viewer.py", "output/test_write_recovery.py",
        "evaluation/test_traced_posterior.py")  # fmt: skip
OPERATORS = ("negate a condition", "drop a statement", "swap two arguments",
             "change a constant", "off by one", "widen a limit")  # fmt: skip
LIMIT = 240  # seconds of the nearest tests, of which there are so many:
SHORTEST = 12
SPARE = 12  # sites of a drawn fault, of which the first that is executed is chosen
FAILED = re.compile(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", re.MULTILINE)


@dataclass(frozen=True)
class Fault:
    """A mistake: ``right`` becomes ``wrong`` where it stands once, or at offset ``start``.

    ``tests`` are the files or tests nearest to it in ``tests``.
    """

    name: str
    file: str
    tests: Sequence[str]
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

    def place(self) -> str:
        """Return the file and the line."""
        return f"{self.file}:{self.line}"

    def planted_line(self) -> str:
        """Return the line with a drawn fault in it."""
        planted = self.planted((ROOT / self.file).read_text(encoding="utf-8"))
        return planted.splitlines()[self.line - 1].strip()


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
    wanted = (mutant for one in nodes for mutant in mutants(one) if mutant[0] == operator)
    for _, node, wrong in wanted:
        right = ast.get_source_segment(text, node)  # type: ignore[arg-type]
        if right and text.isascii():
            start = starts[node.lineno - 1] + node.col_offset  # type: ignore[attr-defined]
            name = f"{operator}: {' '.join(right.split())[:40]}"
            path, line = str(file.relative_to(ROOT)), node.lineno  # type: ignore[attr-defined]
            yield Fault(name, path, (), right, wrong, start, line)


def _inside(node: ast.AST) -> Iterator[ast.AST]:
    """Walk a tree, but for annotations and the parts of strings, and functions in it."""
    yield node
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.JoinedStr | ast.FunctionDef | ast.arguments):
            yield from _inside(child)


def drawn(count: int, seed: int, groups: Sequence[Sequence[str]], spare: int) -> list[list[Fault]]:
    """Draw ``spare`` faults for each of ``count``; groups of rooms and operators take turns."""
    chosen: list[list[Fault]] = []
    for number in range(count):
        operator, rooms = OPERATORS[number % 6], groups[number % len(groups)]
        spots = _spots(rooms, operator)
        if len(spots) < SPARE:  # there are few: those of all rooms
            spots = _spots([room for some in groups for room in some], operator)
        spots = [fault for fault in spots if [fault] not in chosen]
        chosen.append(random.Random(f"{seed} {number}").sample(spots, min(spare, len(spots))))
    return chosen


def _spots(rooms: Iterable[str], operator: str) -> list[Fault]:
    paths = [ROOT / "svu_mi" / room for room in rooms]
    files = [file for path in paths for file in ([path] if path.is_file() else path.rglob("*.py"))]
    return [fault for file in sorted(files) for fault in sites(file, operator)]


def executed(
    chosen: list[list[Fault]], tree: Path, tests: Sequence[str] = ()
) -> tuple[dict[str, list[str]], list[str]]:
    """Return the tests that execute each line, the shortest first, and those that fail already."""
    watched = [fault.place() for some in chosen for fault in some]
    (tree / "watched.json").write_text(json.dumps(watched))
    broken = failures(tree, tests, "-p", "support.faults", "--maxfail", "1000")
    ran: dict[str, dict[str, float]] = {}
    for file in tree.glob("ran.*.json"):
        for place, seconds in json.loads(file.read_text()).items():
            ran.setdefault(place, {}).update(seconds)
    return {place: sorted(tests, key=tests.__getitem__) for place, tests in ran.items()}, broken


class Watcher:
    """Plugin of pytest: records which tests execute the lines that are watched, and their times."""

    def __init__(self, places: list[str]) -> None:
        self.places, self.ran, self.now = set(places), dict[str, set[str]](), ""
        self.files = {place.rpartition(":")[0] for place in places}
        self.root = Path.cwd()  # tests may change it
        self.known: dict[CodeType, str] = {}
        self.seconds: dict[str, float] = {}
        sys.settrace(self.called)
        threading.settrace(self.called)

    def called(self, frame: Any, event: str, _: object) -> Any:
        code = frame.f_code
        if code not in self.known:
            path = os.path.relpath(code.co_filename, self.root)
            self.known[code] = path if path in self.files else ""
        path = self.known[code]
        if event == "line" and f"{path}:{frame.f_lineno}" in self.places:
            self.ran.setdefault(f"{path}:{frame.f_lineno}", set()).add(self.now)
        return self.called if path else None

    def pytest_runtest_setup(self, item: Any) -> None:
        self.now = item.nodeid.removeprefix("tests/")
        sys.settrace(self.called)  # again: a signal that raises in it ends it

    def pytest_runtest_logreport(self, report: Any) -> None:
        test = report.nodeid.removeprefix("tests/")
        self.seconds[test] = self.seconds.get(test, 0) + report.duration

    def pytest_sessionfinish(self) -> None:
        kept = {place: {test: self.seconds.get(test, 0) for test in tests}
                for place, tests in self.ran.items()}  # fmt: skip
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


def failures(tree: Path, tests: Sequence[str], *options: str, limit: float = 3600) -> list[str]:
    """Return which of the fast tests fail, of all if none are named; the first one, by default."""
    kernels = os.environ.get("DRJIT_CACHE_DIR", str(ROOT / ".pytest_cache" / "drjit"))
    paths = os.pathsep.join([str(tree), str(tree / "tests")])
    try:
        run = subprocess.run(
            [sys.executable, "-m", "pytest", "-x", "-m", "not slow", "-n", "2", "--dist",
             "loadfile", *options, *(f"tests/{name}" for name in tests)],
            cwd=tree, env={**os.environ, "PYTHONPATH": paths, "DRJIT_CACHE_DIR": kernels},
            capture_output=True, text=True, check=False, timeout=limit,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return [f"no end within {limit} s"]
    failed = FAILED.findall(run.stdout)
    return failed or ([] if run.returncode in (0, 5) else [(run.stdout + run.stderr)[-200:]])


def tried(fault: Fault, tree: Path, stages: Sequence[Sequence[str]], broken: list[str]) -> str:
    """Plant a fault; return the first test that notices it, or mypy, or nothing.

    The nearest tests go first, then all fast ones with the options of each stage.
    """
    path = tree / fault.file
    text = path.read_text(encoding="utf-8")
    path.write_text(fault.planted(text), encoding="utf-8")
    but = [f"--deselect={name}" for name in broken]
    try:
        noticed = fault.tests and failures(tree, fault.tests, "-n", "0", *but, limit=LIMIT)
        for words in stages:
            if noticed := noticed or failures(tree, (), *words, *but):
                return noticed[0]
        mypy = subprocess.run([sys.executable, "-m", "mypy"], cwd=tree, capture_output=True)
        return "mypy" if mypy.returncode else ""
    finally:
        path.write_text(text, encoding="utf-8")


def main() -> int:
    """Plant the faults one by one, print a table; return how many nothing has noticed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="parts of names of faults")
    parser.add_argument("--machinery", action="store_true")
    parser.add_argument("--slow", action="store_true", help="run slow tests, too")
    parser.add_argument("--drawn", type=int)
    parser.add_argument("--seed", type=int)
    asked = parser.parse_args()
    table = tomllib.loads(FAULTS.read_text())
    harmless = {(row["file"], row["line"]): row["reason"] for row in table["equivalent"]}
    written = (
        []
        if asked.machinery
        else [Fault(**{**row, "tests": row["tests"].split()}) for row in table["fault"]]
    )
    for fault in written:
        fault.planted((ROOT / fault.file).read_text(encoding="utf-8"))  # refused before any work
    groups, count, seed = (MACHINERY, 60, 46) if asked.machinery else (ROOMS, 12, 43)
    count, seed = (count if asked.drawn is None else asked.drawn), asked.seed or seed
    chosen = drawn(count, seed, groups, 1 if asked.machinery else SPARE)
    with tempfile.TemporaryDirectory(prefix="svu-faults-") as folder:
        tree, missed = Path(folder), 0
        copied(tree)
        near = NEAR if asked.machinery else ()
        ran, broken = executed(chosen, tree, near) if chosen else ({}, [])
        if broken:
            print("These fail without any fault:", *broken, file=sys.stderr)
        print("| fault | file | caught by | seconds |\n|---|---|---|--:|", flush=True)
        for some in chosen:  # the first that tests execute, or the only one
            place = next((at for at in map(Fault.place, some) if at in ran), some[0].place())
            if place in ran or asked.machinery:
                fault = next(fault for fault in some if fault.place() == place)
                written.append(replace(fault, tests=ran.get(place, [])[:SHORTEST]))
        for fault in written:
            if not asked.only or any(part in fault.name for part in asked.only):
                start, stages = time.perf_counter(), [[], *([["-m", "slow"]] if asked.slow else [])]
                reason = harmless.get((fault.file, fault.planted_line()))
                noticed = f"equivalent: {reason}" if reason else tried(fault, tree, stages, broken)
                missed += not noticed
                print(f"| {fault.name} | `{fault.file}` {fault.line or ''} | "
                      f"{noticed or '**nothing**'} | {time.perf_counter() - start:.0f} |",
                      flush=True)  # fmt: skip
    return missed


if __name__ == "__main__":
    raise SystemExit(main())

"""Plant a fault in the sources, run the tests until one fails, take the fault out again."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from studies.faults.faults import Fault

from svu_mi.errors import OptionError

ROOT = Path(__file__).parents[3]
FAILED = re.compile(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", re.MULTILINE)


@dataclass(frozen=True)
class Outcome:
    """What the tests said of a fault.

    Attributes:
        fault: the fault.
        test: the first test that failed; None if none did.
        seconds: until then.
    """

    fault: Fault
    test: str | None
    seconds: float


def source(fault: Fault, root: Path = ROOT) -> str:
    """Return the sources that a fault is planted in.

    Raises:
        OptionError: what it replaces is not there exactly once.
    """
    text = (root / fault.file).read_text()
    found = text.count(fault.right)
    if found != 1:
        raise OptionError(
            f"{fault.file}: {fault.right!r} stands there {found} times, not once; "
            f"write the fault '{fault.name}' for what the file says now."
        )
    return text


@contextmanager
def planted(fault: Fault, root: Path = ROOT) -> Iterator[None]:
    """Keep a fault in the sources for a while."""
    text, path = source(fault, root), root / fault.file
    path.write_text(text.replace(fault.right, fault.wrong))
    try:
        yield
    finally:
        path.write_text(text)


def try_out(fault: Fault) -> Outcome:
    """Run the tests nearest to a fault, then all that ``make test`` runs, until one fails."""
    start = time.perf_counter()
    with planted(fault):
        test = _first_failure([f"tests/{name}" for name in fault.tests]) or _first_failure([])
    return Outcome(fault, test, time.perf_counter() - start)


def table(outcomes: list[Outcome]) -> str:
    """Return what was found as Markdown."""
    lines = ["| fault | kind | file | caught by | seconds |", "|---|---|---|---|--:|"]
    for one in outcomes:
        caught = f"`{one.test}`" if one.test else "**nothing**"
        fault = one.fault
        lines.append(
            f"| {fault.name} | {fault.kind} | `{fault.file}` | {caught} | {one.seconds:.0f} |"
        )
    return "\n".join(lines)


def _first_failure(tests: list[str]) -> str | None:
    words = [sys.executable, "-m", "pytest", "-x", "-m", "not slow", "-n", "2", *tests]
    run = subprocess.run(
        [*words, "--dist", "loadfile"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    failed = FAILED.search(run.stdout)
    if failed:
        return failed[1]
    return None if run.returncode == 0 else (run.stdout + run.stderr).strip().splitlines()[-1]

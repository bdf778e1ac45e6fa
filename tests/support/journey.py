"""A user's terminal: one process per command line, without environment variables."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

# What the tests around set, or a developer has set: a new user has none of it. Only the folder of
# compiled kernels is that of other processes of tests, for which they are compiled alike.
NOT_SET = ("DRJIT_", "OPENBLAS_", "MPL", "MI_", "PYTHONUTF8", "PYTHONIOENCODING", "PYTEST_")
SHARED = "DRJIT_CACHE_DIR"
SECONDS = 120
STAGE = re.compile(r".*: (failed after )?[0-9.]+ s(, [0-9]+ kernels? compiled)?")


@dataclass(frozen=True)
class Said:
    """What a line has printed.

    Attributes:
        out: lines of standard output, without those on stages and their times.
        err: lines of standard error.
        status: of the process.
    """

    out: list[str]
    err: list[str]
    status: int

    @property
    def warnings(self) -> list[str]:
        """Warnings, without what marks them."""
        mark = "svu: warning: "
        return [line.removeprefix(mark) for line in self.err if line.startswith(mark)]

    @property
    def refusal(self) -> str:
        """The one line of a command that could not do its work."""
        assert self.status == 2, self
        lines = [line for line in self.err if not line.startswith("svu: warning: ")]
        assert len(lines) == 1 and lines[0].startswith("svu: "), self
        return lines[0].removeprefix("svu: ")


def svu(line: str, folder: Path, *before: str) -> Said:
    """Type ``svu ...`` in a folder; ``before`` it may stand such as ``taskset -c 0``."""
    return typed([*before, sys.executable, "-m", "svu_mi", *shlex.split(line)], folder)


def done(line: str, folder: Path, *before: str) -> Said:
    """Type a line that must succeed."""
    said = svu(line, folder, *before)
    assert said.status == 0, said
    return said


def notebook(code: str, folder: Path) -> Said:
    """Run cells of a notebook in a new kernel."""
    return typed([sys.executable, "-c", code], folder)


def stopped(line: str, folder: Path, sign: str) -> Said:
    """Type a line, and press Ctrl-C as soon as a file of this pattern is there."""
    return typed([sys.executable, "-m", "svu_mi", *shlex.split(line)], folder, sign)


def typed(words: list[str], folder: Path, sign: str = "") -> Said:
    """Run a process as a user would; with a sign, until that is seen."""
    kept = {
        key: value for key, value in os.environ.items()
        if key == SHARED or not key.startswith(NOT_SET)
    }  # fmt: skip
    with subprocess.Popen(
        words, cwd=folder, env=kept, text=True, encoding="utf-8", stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        try:
            end = time.monotonic() + SECONDS
            while sign and not list(folder.rglob(sign)):
                assert process.poll() is None and time.monotonic() < end, process.communicate()
                time.sleep(0.02)
            if sign:
                process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=SECONDS)
        finally:
            process.kill()
    lines = [line for line in out.splitlines() if not STAGE.fullmatch(line)]
    return Said(lines, err.splitlines(), process.returncode)

"""Damage valid files in many ways and read them: each must be read, or refused in one sentence.

Runs as a program of its own, since a library may abort the process: ``fuzzing.py FOLDER COUNT
[SEED [FIRST [FORMAT]]]``. What it has to say goes to ``FOLDER/report.json``; the variant that it
is at stands in ``FOLDER/current``, which outlives a crash.
"""

from __future__ import annotations

import faulthandler
import gc
import json
import logging
import math
import os
import random
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from svu_mi.errors import SvuError, SvuWarning

# isort: split
# Behind svu_mi, which chooses LLVM before Dr.Jit is imported.
from support.fuzz_formats import FORMATS, Format
from support.fuzz_records import RECORDS
from support.mutations import damaged

SEED = 5417
MEMORY = 3 * 2**29  # bytes of addresses that reading may need beyond what the libraries have
SECONDS = 2  # of this process, per variant
PATIENCE = 60  # seconds on the clock, for what waits without computing
LONGEST = 500  # letters of a message, beyond the path of the folder


class Fuzzer:
    """Reads damaged files, one after the other, and keeps what must not happen."""

    def __init__(self, folder: Path, formats: Sequence[Format]) -> None:
        self.folder = folder
        self.formats = formats
        self._current = _opened(folder / "current")
        self.failures: list[str] = []
        self.counts: dict[str, Counter[str]] = {kind.name: Counter() for kind in formats}
        self.slowest = 0.0, ""
        self._allowed: tuple[str, ...] = ()
        self._written: list[str] = []
        self._said = _opened(folder / "said")
        crashes = _opened(folder / "crashes")
        for number in (1, 2):
            os.dup2(self._said, number)
        faulthandler.enable(crashes)
        faulthandler.register(signal.SIGPROF, crashes, chain=True)
        faulthandler.register(signal.SIGALRM, crashes, chain=True)
        sys.addaudithook(self._audit)
        (folder / "temporary").mkdir()
        tempfile.tempdir = str(folder / "temporary")

    def try_all(self, count: int, seed: int, first: int) -> None:
        """Try ``count`` variants, shared by all formats."""
        valid = [_prepared(kind, self.folder / kind.name) for kind in self.formats]
        gc.freeze()
        _limit_memory()
        rounds = math.ceil(count / sum(1 / kind.share for kind in self.formats))
        for index in range(first, first + rounds):
            for kind, files in zip(self.formats, valid, strict=True):
                if index % kind.share:
                    continue
                draw = random.Random(f"{seed} {kind.name} {index}")
                name, data, change = damaged(files, draw)
                path = self.folder / kind.name / "in" / name
                if draw.random() < 0.02:
                    change = draw.choice(list(OBSTACLES))
                    path.unlink()
                    OBSTACLES[change](path)
                else:
                    path.write_bytes(data)
                self.try_one(kind, f"{kind.name} {index} ({change})")
                if path.is_dir():
                    path.rmdir()
                path.unlink(missing_ok=True)
                path.write_bytes(files[name])

    def try_one(self, kind: Format, label: str) -> None:
        """Read one variant."""
        os.truncate(self._current, 0)
        os.write(self._current, label.encode())
        folder, out = self.folder / kind.name / "in", self.folder / kind.name / "out"
        before, started = _tree(folder), time.process_time()
        self._allowed = (str(out), tempfile.gettempdir())
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        signal.setitimer(signal.ITIMER_REAL, PATIENCE)
        try:
            kind.read(folder, out)
            outcome = "read"
        except SvuError as error:
            outcome = "refused"
            self._judge(label, str(error), str(folder.parent))
        except BaseException as error:
            outcome = "failed"
            self._fail(label, "".join(traceback.format_exception(error, limit=-4)))
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.setitimer(signal.ITIMER_REAL, 0)
            self._allowed = ()
        self.counts[kind.name][outcome] += 1
        self.slowest = max(self.slowest, (time.process_time() - started, label))
        if _tree(folder) != before:
            self._fail(label, "changed the folder that it has read")
        if self._written:
            self._fail(label, f"has written {self._written}")
            self._written.clear()
        if said := os.pread(self._said, 300, 0):
            self._fail(label, f"has printed {said!r}")
            os.truncate(self._said, 0)

    def report(self) -> dict[str, Any]:
        """Return all that was found."""
        usage = resource.getrusage(resource.RUSAGE_SELF)
        return {
            "failures": self.failures,
            "counts": self.counts,
            "slowest": self.slowest,
            "peak": _peak(),
            "seconds": usage.ru_utime + usage.ru_stime,
        }

    def _judge(self, label: str, text: str, folder: str) -> None:
        if folder not in text:
            self._fail(label, f"names no file: {text!r}")
        if re.search(r"[\0-\x1f\x7f-\x9f]", text) or len(text.replace(folder, "")) > LONGEST:
            self._fail(label, f"is no sentence: {text[:1000]!r}")

    def _fail(self, label: str, what: str) -> None:
        self.failures.append(f"{label} {what}")

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Note what Python writes elsewhere; the libraries' own files are in _tree."""
        if not self._allowed or event not in CHANGES:
            return
        path, *others = arguments
        if event == "open":
            writes = others[1] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        else:
            writes = others[-1:] in ([], [-1], [None])  # else relative to a folder that was found
        if writes and isinstance(path, str | bytes | os.PathLike):
            text = os.path.abspath(os.fsdecode(path))
            if not text.startswith(self._allowed) and text != os.devnull:
                self._written.append(f"{event} {text}")


# What may stand where a file is expected.
OBSTACLES: dict[str, Callable[[Path], None]] = {
    "a folder": Path.mkdir,
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a link to nothing": lambda path: path.symlink_to("nowhere"),
}
CHANGES = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink",
           "shutil.rmtree")  # fmt: skip


def _opened(path: Path) -> int:
    return os.open(path, os.O_CREAT | os.O_RDWR | os.O_TRUNC | os.O_APPEND)


def _prepared(kind: Format, folder: Path) -> dict[str, bytes]:
    """Write the valid files of a format, with neighbours that names may lead to; read them.

    Returns:
        What may be damaged, by name.
    """
    source, out = folder / "in", folder / "out"
    source.mkdir(parents=True)
    out.mkdir()
    kind.make(source)
    files = [path for path in source.rglob(kind.targets) if path.is_file()]
    valid = {str(path.relative_to(source)): path.read_bytes() for path in files}
    (folder / "secret").write_text("out of bounds")
    (source / "folder").mkdir()
    (source / "link").symlink_to("../secret")
    (source / "loop").symlink_to("loop")
    os.mkfifo(source / "pipe")
    kind.read(source, out)  # loads libraries, too
    return valid


def _tree(folder: Path) -> list[tuple[str, int, int]]:
    """Return name, size and time of all files, links not followed."""
    entries = []
    for root, folders, files in os.walk(folder):
        for name in folders + files:
            status = os.lstat(os.path.join(root, name))
            entries.append((f"{root}/{name}", status.st_size, status.st_mtime_ns))
    return entries


def _peak() -> int:
    """Return how many bytes this process has had in use at most.

    Not ``ru_maxrss``, which begins with what the process had that started this one.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith("VmHWM"))
    return int(line.split()[1]) * 1024


def _limit_memory() -> None:
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY,) * 2)


def main(folder: str, count: str, seed: str = str(SEED), first: str = "0", name: str = "") -> None:
    """Fuzz, and write the report."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)  # as the program does
    logging.basicConfig()  # the program would take its own stderr for it
    warnings.simplefilter("always")  # an error of ours would hide in a reader's
    for category in (SvuWarning, ResourceWarning, DeprecationWarning):
        warnings.simplefilter("ignore", category)
    formats = [kind for kind in (*FORMATS, *RECORDS) if name in ("", kind.name)]
    fuzzer = Fuzzer(Path(folder), formats)
    fuzzer.try_all(int(count), int(seed), int(first))
    Path(folder, "report.json").write_text(json.dumps(fuzzer.report(), indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])

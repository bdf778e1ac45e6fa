"""Runs the steps of all captures, some captures at a time, each command in a process of its own.

The batch itself computes nothing: its memory stays what it is, however many captures there are, and
a command that dies takes nothing with it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

from svu_mi.batch.listing import Item
from svu_mi.batch.record import Done, Outcome, figures_of
from svu_mi.batch.steps import STEPS, inputs_key, key_of, words_of
from svu_mi.errors import SvuError, excerpt
from svu_mi.files import prepare_folder
from svu_mi.memory import free_memory
from svu_mi.results.exchange import locked

TRIES = 3  # of a command that is killed from outside
INTERRUPTED = 130  # exit status after Ctrl-C, which reaches the commands, too
KILOBYTE = 1024
CORNER, LAST_CORNER, BOX = "╭", "╰", "╭╮╰╯│─ "  # drawn around what is wrong with options


class Ended(NamedTuple):
    """How a process ended: its exit status, what it said last, and bytes at its peak."""

    status: int
    said: str
    peak: int


@dataclass(frozen=True, kw_only=True)
class Shelf:
    """How captures are worked on.

    Attributes:
        output: folder that gets a folder per capture.
        steps: names of ``STEPS``, in their order.
        workers: captures at a time.
        words: that every command gets, such as ``-t 2``; of these only ``-m`` changes results.
        patience: seconds to wait for others that work on the same capture.
        options: of all captures (``Item.options``), where they have none of their own.
    """

    output: Path
    steps: Sequence[str] = tuple(STEPS)
    workers: int = 1
    words: tuple[str, ...] = ()
    patience: float = 0
    options: dict[str, str] = field(default_factory=dict)

    def run(self, items: Sequence[Item]) -> Iterator[Outcome]:
        """Work on captures; yield what became of each, as they end.

        Closing the iterator, or an exception such as Ctrl-C, ends the commands that are running.
        """
        free, workers = free_memory(), max(min(self.workers, len(items)), 1)
        share = 0 if free is None or workers == 1 else free // workers
        processes = Processes(share)
        with ThreadPoolExecutor(workers) as threads:
            work = [threads.submit(self.work, item, processes) for item in items]
            try:
                for future in as_completed(work):
                    yield future.result()
            finally:
                for future in work:
                    future.cancel()
                processes.end()

    def work(self, item: Item, processes: Processes) -> Outcome:
        """Take the steps of one capture that are not done; what goes wrong is said, not raised."""
        item = replace(item, options=self.options | item.options)
        folder = self.output / item.name
        done, outcome = Done(folder), Outcome(item.name, folder)
        try:
            prepare_folder(folder)
            with locked(folder.resolve(), wait=self.patience):
                done = Done.read(folder)
                for reached in self._taken(item, done, processes):
                    outcome = reached
        except (OSError, SvuError) as error:
            outcome = replace(outcome, sentence=_problem(error, folder))
        taken = [done.steps[name] for name in outcome.done]
        return replace(
            outcome, seconds=sum(step["seconds"] for step in taken),
            peak=max((step["peak_bytes"] for step in taken), default=0),
            figures=figures_of(folder) if "entropy" in outcome.done else {},
        )  # fmt: skip

    def _taken(self, item: Item, done: Done, processes: Processes) -> Iterator[Outcome]:
        """Yield what has become of a capture after each step; the first that fails is the last."""
        outcome, key = Outcome(item.name, done.folder), inputs_key(item, self.output)
        for name, step in STEPS.items():
            if name not in self.steps:
                continue
            words = words_of(step, item, done.folder, self.steps)
            key = key_of([*words, *self._variant()], key)
            if not done.has(name, key, done.folder / step.proof):
                left = step.left_in(done.folder)
                done.begin(name, key, left)
                start = time.perf_counter()
                ended = _tried(processes, [*words, *self.words], left)
                if ended.status:
                    said = ended.said or f"ended with status {ended.status}"
                    yield replace(outcome, sentence=f"{step.command}: {said}")
                    return
                done.add(name, key, time.perf_counter() - start, ended.peak)
                outcome = replace(outcome, made=outcome.made + 1)
            outcome = replace(outcome, done=(*outcome.done, name))
            yield outcome

    def _variant(self) -> tuple[str, ...]:
        """Return those of the words that say which variant of Mitsuba computes."""
        if "-m" not in self.words:
            return ()
        start = self.words.index("-m")
        return self.words[start : start + 2]


def _problem(error: OSError | SvuError, folder: Path) -> str:
    """Say what cannot be read or written."""
    if isinstance(error, SvuError):
        return error.shell
    place = folder if error.filename is None else error.filename
    return f"{excerpt(place)}: {error.strerror or error}; the same command tries it again."


def _tried(processes: Processes, words: Sequence[str], left: Path | None) -> Ended:
    """Run a command again, if somebody else has killed it, from what it left unfinished; from the
    beginning, if it cannot go on from that."""
    for _ in range(TRIES):
        resumes = left is not None and left.is_file()
        ended = processes.run([*words, "--resume"] if resumes else words)
        if resumes and left is not None and ended.status > 0 and ended.status != INTERRUPTED:
            left.unlink(missing_ok=True)
            ended = processes.run(words)
        if ended.status >= 0:
            return ended
    return ended._replace(said=f"was killed {TRIES} times (signal {-ended.status})")


class Processes:
    """The commands that are running; none starts any more once they were ended."""

    def __init__(self, memory: int = 0) -> None:
        self._memory = memory
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._over = False

    def run(self, words: Sequence[str]) -> Ended:
        """Run ``svu`` with words, to its end."""
        own = [str(os.getpid()), str(self._memory)]
        # -P: Python would look for every module in the working directory first.
        line = [sys.executable, "-P", "-m", "svu_mi.batch.worker", *own, *words]
        with self._lock:
            if self._over:
                return Ended(INTERRUPTED, "not begun", 0)
            process = subprocess.Popen(
                line, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
            )
            self._running.add(process)
        try:
            assert process.stderr is not None
            said = process.stderr.read().decode("utf-8", "replace").strip()
            status, peak = _waited(process)
        finally:
            with self._lock:
                self._running.discard(process)
        if status and self._over:  # not its fault: what it left is good
            status = INTERRUPTED
        return Ended(status, sentence_of(said), peak)

    def end(self) -> None:
        """Kill what is running; results are written in one step, so none is left half-written."""
        with self._lock:
            self._over = True
            for process in self._running:
                process.kill()


def sentence_of(said: str) -> str:
    """Return what a command has said last: its last line with words, or what is in a box at the
    end, which wraps a sentence about an option and goes on with a hint below a rule."""
    lines = said.rstrip().splitlines()
    texts = [line.strip(BOX) for line in lines]
    if lines and lines[-1].startswith(LAST_CORNER):
        tops = [number for number, line in enumerate(lines) if line.startswith(CORNER)]
        return " ".join(takewhile(_has_words, texts[tops[-1] + 1 if tops else 0 :]))
    last = next((text for text in reversed(texts) if _has_words(text)), "")
    return last.removeprefix("svu: ")


def _has_words(text: str) -> bool:
    return any(map(str.isalnum, text))


def _waited(process: subprocess.Popen[bytes]) -> tuple[int, int]:
    """Return the exit status of a process, and bytes at its peak; 0 where nobody says."""
    if not hasattr(os, "wait4"):  # Windows
        return process.wait(), 0
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    unit = 1 if sys.platform == "darwin" else KILOBYTE
    return process.returncode, usage.ru_maxrss * unit

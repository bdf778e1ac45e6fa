"""Runner of batches: one process per command, on this machine or a Dask cluster.

Commands run in child processes: the memory of the batch is independent of the number of captures,
and a command that crashes does not end the batch.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from svu_mi.cli.batch.capture_list import PATHS, BatchItem
from svu_mi.cli.batch.steps import STEPS, command_words, inputs_key, read_done, step_key, write_done
from svu_mi.core.io.files import prepare_folder
from svu_mi.core.io.folder_exchange import locked
from svu_mi.core.io.schema import NUMBER, Field, read_record
from svu_mi.core.memory import free_memory
from svu_mi.errors import OptionError, SvuEnvironmentError, SvuError, excerpt

PART = Field(NUMBER, (), 0, 1)
INTERVALS = Field({"seen_part": PART, "all_known_part": PART._replace(default=None)})
ENTROPY = {"result": Field({"intervals": INTERVALS, "mean_entropy_of_seen": PART})}
TRIES = 3  # if a command is killed from outside
INTERRUPTED = 130  # exit status after Ctrl-C, which also reaches the commands
KILOBYTE = 1024
BOX = "╭╮╰╯│─ "  # characters around lines of rich
DAY = 86400.0  # seconds
SECONDS = 30  # timeout of a connection to a scheduler
_one_at_a_time = threading.Lock()  # a worker runs one task per thread


class ProcessResult(NamedTuple):
    """Exit status of a process, its last message, and its peak memory in bytes."""

    status: int
    message: str
    peak: int


@dataclass(frozen=True)
class Outcome:
    """Result of one capture.

    Attributes:
        name: Name of the capture.
        folder: Folder of its results.
        sentence: Error message; empty on success.
        seconds: Total time of its steps, including earlier runs.
        peak: Peak memory of its processes in bytes.
        steps_run: Number of steps of this run.
        done: Names of the steps with current results.
        figures: ``seen``, ``entropy`` and ``known`` from ``svu entropy``, in [0, 1].
    """

    name: str
    folder: Path
    sentence: str = ""
    seconds: float = 0.0
    peak: int = 0
    steps_run: int = 0
    done: tuple[str, ...] = ()
    figures: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class BatchRunner:
    """Runner of the steps of all captures.

    Attributes:
        output: Folder for the results, one subfolder per capture.
        steps: Names of steps, in the order of ``STEPS``.
        workers: Number of captures processed at the same time on this machine.
        variant: Mitsuba variant.
        words: Arguments passed to every command that leave results unchanged, such as ``-t 2``.
        patience: Seconds to wait for another process that works on the same capture.
        options: Default options of all captures (``BatchItem.options``).
    """

    output: Path
    steps: Sequence[str] = tuple(STEPS)
    workers: int = 1
    variant: str = "auto"
    words: tuple[str, ...] = ()
    patience: float = 0
    options: dict[str, str] = field(default_factory=dict)

    def run(self, items: Sequence[BatchItem]) -> Iterator[Outcome]:
        """Process captures on this machine; yield outcomes as they finish.

        Closing the iterator, or an exception such as Ctrl-C, kills running commands.
        """
        free, workers = free_memory(), max(min(self.workers, len(items)), 1)
        commands = CommandPool(0 if free is None or workers == 1 else free // workers)
        with ThreadPoolExecutor(workers) as threads:
            work = [threads.submit(self.work, item, commands) for item in items]
            try:
                for future in as_completed(work):
                    yield future.result()
            finally:
                for future in work:
                    future.cancel()
                commands.end()

    def run_on_cluster(self, address: str, items: Sequence[BatchItem]) -> Iterator[Outcome]:
        """Process captures on Dask workers; tasks of workers that die are repeated by others."""
        with dask_client(address) as client:
            from distributed import KilledWorker, as_completed

            if not client.scheduler_info().get("workers"):
                raise OptionError(
                    "The cluster has no workers; start some with: dask worker ADDRESS."
                )
            # Workers of a stopped batch finish their capture: wait for their locks.
            there = replace(self, output=self.output.absolute(), patience=DAY)
            futures = {
                client.submit(work_on_cluster, there, _absolute(item), pure=False): item
                for item in items
            }
            try:
                for future in as_completed(futures):
                    item = futures[future]
                    try:
                        yield future.result()
                    except KilledWorker:
                        said = "terminated all workers that tried it; see their logs"
                        yield Outcome(item.name, there.output / item.name, said)
            finally:
                client.cancel(list(futures))

    def work(self, item: BatchItem, commands: CommandPool) -> Outcome:
        """Run the missing steps of one capture; return errors in ``Outcome.sentence``."""
        item = replace(item, options=self.options | item.options)
        folder = self.output / item.name
        outcome, done = Outcome(item.name, folder), {}
        try:
            prepare_folder(folder)
            with locked(folder.resolve(), wait=self.patience):
                done = read_done(folder)
                for reached in self._run_steps(item, folder, done, commands):
                    outcome = reached
        except SvuError as error:
            outcome = replace(outcome, sentence=error.shell)
        except OSError as error:
            place = folder if error.filename is None else error.filename
            said = f"{excerpt(place)}: {error.strerror or error}; run the same command to retry."
            outcome = replace(outcome, sentence=said)
        taken = [done[name] for name in outcome.done]
        return replace(
            outcome, seconds=sum(step["seconds"] for step in taken),
            peak=max((step["peak_bytes"] for step in taken), default=0),
            figures=_figures_of(folder) if "entropy" in outcome.done else {},
        )  # fmt: skip

    def _run_steps(
        self, item: BatchItem, folder: Path, done: dict[str, dict[str, Any]], commands: CommandPool
    ) -> Iterator[Outcome]:
        """Yield the outcome after each step; stop at the first failure."""
        outcome, key = Outcome(item.name, folder), inputs_key(item, self.output)
        for name, step in STEPS.items():
            if name not in self.steps:
                continue
            words = command_words(step, item, folder, self.steps)
            words += ["-m", self.variant]
            key = step_key(words, key)
            # Results are written atomically: they are complete if their last file exists.
            if done.get(name, {}).get("key") != key or not (folder / step.proof).is_file():
                left = folder / step.checkpoint if step.checkpoint else None
                start = time.perf_counter()
                ended = _run_command(commands, [*words, *self.words], left)
                if ended.status or not (folder / step.proof).is_file():
                    said = ended.message or f"ended with status {ended.status}, without a result"
                    yield replace(outcome, sentence=f"{step.command}: {said}")
                    return
                seconds = round(time.perf_counter() - start, 2)
                done[name] = {"key": key, "seconds": seconds, "peak_bytes": ended.peak}
                write_done(folder, done)
                outcome = replace(outcome, steps_run=outcome.steps_run + 1)
            outcome = replace(outcome, done=(*outcome.done, name))
            yield outcome


def work_on_cluster(runner: BatchRunner, item: BatchItem) -> Outcome:
    """Run the steps of one capture in a cluster worker, with its threads and memory."""
    from distributed import get_worker

    from svu_mi.core.threads import FEWEST_THREADS

    worker, words = get_worker(), runner.words
    if "-t" not in words:
        words += ("-t", str(max(worker.state.nthreads, FEWEST_THREADS)))
    memory = worker.memory_manager.memory_limit or 0
    with _one_at_a_time:
        return replace(runner, words=words).work(item, CommandPool(memory))


def _absolute(item: BatchItem) -> BatchItem:
    """Return an item with absolute paths."""
    paths = {
        name: str(Path(item.options[name]).absolute()) for name in PATHS if name in item.options
    }
    return replace(item, capture=item.capture.absolute(), options=item.options | paths)


@contextmanager
def dask_client(address: str) -> Iterator[Any]:
    """Connect to the Dask scheduler at an address, such as ``tcp://10.0.0.5:8786``.

    Yields:
        A ``distributed.Client``.
    """
    try:
        from distributed import Client
        from distributed.comm import CommClosedError  # while receiving a result
    except ImportError as error:
        raise SvuEnvironmentError(
            "A scheduler needs Dask; install it with: pip install 'svu_mi[cluster]'."
        ) from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)  # errors are raised here
    label = f"--scheduler {excerpt(address, 80)}"
    try:
        client = Client(address, timeout=SECONDS)
    except (OSError, ValueError, TimeoutError) as error:
        raise OptionError(
            f"{label}: no answer within {SECONDS} s ({excerpt(error, 80)}); start one with: "
            "dask scheduler."
        ) from error
    try:
        yield client
    except (CancelledError, CommClosedError) as error:
        raise SvuError(
            f"{label}: the connection was lost; run the same command to continue."
        ) from error
    finally:
        with suppress(Exception):  # the connection may be lost
            client.close()


def _run_command(commands: CommandPool, words: Sequence[str], left: Path | None) -> ProcessResult:
    """Run a command; if a signal kills it, run it again, from the checkpoint ``left`` if any."""
    for _ in range(TRIES):
        resumes = left is not None and left.is_file()
        ended = commands.run([*words, "--resume"] if resumes else words)
        if resumes and left is not None and ended.status > 0 and ended.status != INTERRUPTED:
            left.unlink(missing_ok=True)  # damaged, or from other inputs
            ended = commands.run(words)
        if ended.status >= 0:
            return ended
    return ended._replace(message=f"was killed {TRIES} times (signal {-ended.status})")


class CommandPool:
    """Pool of running commands; after ``end``, no command starts."""

    def __init__(self, memory: int = 0) -> None:
        self._memory = memory
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._over = False

    def run(self, words: Sequence[str]) -> ProcessResult:
        """Run ``svu`` with the given words, and wait for it."""
        own = [str(os.getpid()), str(self._memory)]
        # Without -P, modules in the working directory take precedence.
        line = [sys.executable, "-P", "-m", "svu_mi.cli.batch.child_process", *own, *words]
        with self._lock:
            if self._over:
                return ProcessResult(INTERRUPTED, "not started", 0)
            process = subprocess.Popen(
                line, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
            )
            self._running.add(process)
        try:
            assert process.stderr is not None
            said = process.stderr.read().decode("utf-8", "replace").strip()
            status, peak = _wait_for(process)
        finally:
            with self._lock:
                self._running.discard(process)
        if status and self._over:  # killed by ``end``
            status = INTERRUPTED
        return ProcessResult(status, last_sentence(said), peak)

    def end(self) -> None:
        """Kill running commands; results stay complete, as they are written atomically."""
        with self._lock:
            self._over = True
            for process in self._running:
                process.kill()


def last_sentence(said: str) -> str:
    """Return the error message of a command: its last line."""
    texts = [line.strip(BOX) for line in said.splitlines()]
    return next(filter(None, reversed(texts)), "").removeprefix("svu: ")


def _wait_for(process: subprocess.Popen[bytes]) -> tuple[int, int]:
    """Return the exit status of a process, and its peak memory in bytes (0 if unknown)."""
    if not hasattr(os, "wait4"):  # Windows
        return process.wait(), 0
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    unit = 1 if sys.platform == "darwin" else KILOBYTE
    return process.returncode, usage.ru_maxrss * unit


def _figures_of(folder: Path) -> dict[str, float]:
    """Read the figures of ``svu entropy``; an empty dictionary if missing."""
    try:
        result = read_record(folder / "entropy" / "run.json", ENTROPY, "compute it again")["result"]
    except SvuError:
        return {}
    intervals = result["intervals"]
    figures = {
        "seen": intervals["seen_part"], "entropy": result["mean_entropy_of_seen"],
        "known": intervals["all_known_part"],
    }  # fmt: skip
    return {name: value for name, value in figures.items() if value is not None}

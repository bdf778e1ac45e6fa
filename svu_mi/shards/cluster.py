"""Hands tasks out to the workers of a cluster, or does them in this process, one by one."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from typing import Any

from svu_mi.errors import OptionError, SvuEnvironmentError, SvuError, excerpt
from svu_mi.shards.job import Done, Task
from svu_mi.shards.work import Worker, work

Report = Callable[[int, int], None]
SECONDS = 30  # to reach a scheduler


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """Be connected to the Dask scheduler at an address, such as ``tcp://10.0.0.5:8786``.

    Yields:
        A ``distributed.Client``; None without an address.

    Raises:
        SvuEnvironmentError: Dask is not installed.
        OptionError: nobody answers there.
        SvuError: it was there, and is no more.
    """
    if not address:
        yield None
        return
    client = _client(address)
    from distributed.comm import CommClosedError  # of a result that is on its way

    try:
        yield client
    except (CancelledError, CommClosedError) as error:
        raise SvuError(
            f"--scheduler {excerpt(address, 80)}: the connection was lost; what is done is kept, "
            "and the same command goes on."
        ) from error
    finally:
        with suppress(Exception):  # it may have gone
            client.close()


def _client(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError as error:
        raise SvuEnvironmentError(
            "A scheduler needs Dask; install it with: pip install 'svu_mi[cluster]'."
        ) from error
    try:
        logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)  # we say it ourselves
        return Client(address, timeout=SECONDS)
    except (OSError, ValueError, TimeoutError) as error:
        raise OptionError(
            f"--scheduler {excerpt(address, 80)}: nobody answers there within {SECONDS} s "
            f"({excerpt(error, 80)}); start one with: dask scheduler."
        ) from error


def run(client: Any, tasks: Sequence[Task], homes: dict[int, str], report: Report) -> list[Done]:
    """Do all tasks; when this returns, their sums are on disk.

    Args:
        client: a ``distributed.Client``; None for this process.
        tasks: one per shard, in order.
        homes: addresses of the workers that have loaded shards, by shard: they get them again if
            they are still there.
        report: called with the number of tasks that are done, and of all.

    Raises:
        SvuError: of a task, or of a cluster without workers.
    """
    if client is None:
        found = []
        for task in tasks:
            found.append(work(task))
            report(len(found), len(tasks))
        return found
    return _handed_out(client, tasks, homes, report)


def _handed_out(
    client: Any, tasks: Sequence[Task], homes: dict[int, str], report: Report
) -> list[Done]:
    from distributed import as_completed

    require_workers(client)
    futures = [
        client.submit(
            work_there, task, pure=False, allow_other_workers=task.shard in homes,
            workers=[homes[task.shard]] if task.shard in homes else None,
        )
        for task in tasks
    ]  # fmt: skip
    found: list[Done] = []
    try:
        for future in as_completed(futures):
            found.append(_result(future))
            report(len(found), len(tasks))
    finally:
        client.cancel(futures)
    return sorted(found, key=lambda done: done.shard)


def require_workers(client: Any) -> None:
    """Refuse a cluster that would wait for ever.

    Raises:
        OptionError: it has no workers.
    """
    if not client.scheduler_info().get("workers"):
        raise OptionError("The cluster has no workers; start some with: dask worker ADDRESS.")


def _result(future: Any) -> Done:
    from distributed import KilledWorker

    try:
        done: Done = future.result()
    except KilledWorker as error:
        raise SvuError(
            "A shard has ended every worker that it was given to; their logs may say why. Too "
            "little memory is the usual reason: use more shards."
        ) from error
    return done


def work_there(task: Task) -> Done:
    """Do a task in a worker of a cluster."""
    from distributed import get_worker

    worker = get_worker()
    limit = worker.memory_manager.memory_limit
    return work(task, Worker(worker.address, worker.state.nthreads, limit or None))

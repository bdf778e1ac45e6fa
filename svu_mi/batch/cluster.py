"""Captures as tasks of a cluster: a worker runs the commands of one capture at a time."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any

from svu_mi.batch.listing import PATHS, Item
from svu_mi.batch.record import Outcome
from svu_mi.batch.shelf import Processes, Shelf
from svu_mi.errors import OptionError, SvuEnvironmentError, SvuError, excerpt
from svu_mi.limits import FEWEST_THREADS

DAY = 86400.0  # seconds
SECONDS = 30  # to reach a scheduler
_one_at_a_time = Lock()  # a worker has as many tasks at once as it has threads


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


def require_workers(client: Any) -> None:
    """Refuse a cluster that would wait for ever.

    Raises:
        OptionError: it has no workers.
    """
    if not client.scheduler_info().get("workers"):
        raise OptionError("The cluster has no workers; start some with: dask worker ADDRESS.")


def run_there(client: Any, shelf: Shelf, items: Sequence[Item]) -> Iterator[Outcome]:
    """Have the workers of a cluster work on captures; yield what became of each, as they end.

    They see the same files. One that ends costs the command it was at: another one goes on.

    Args:
        client: a ``distributed.Client``.
        shelf: how captures are worked on; its workers count for nothing.
        items: the captures.

    Raises:
        OptionError: the cluster has no workers.
    """
    from distributed import KilledWorker, as_completed

    require_workers(client)
    # A batch that was stopped leaves workers at their captures: their results are waited for.
    shelf = replace(shelf, output=shelf.output.absolute(), patience=DAY)
    futures = {
        client.submit(work_there, shelf, _absolute(item), pure=False): item for item in items
    }
    try:
        for future in as_completed(futures):
            item = futures[future]
            try:
                yield future.result()
            except KilledWorker:
                said = "ended every worker that it was given to; their logs may say why"
                yield Outcome(item.name, shelf.output / item.name, said)
    finally:
        client.cancel(list(futures))


def work_there(shelf: Shelf, item: Item) -> Outcome:
    """Take the steps of one capture, in a worker of a cluster, with its threads and its memory."""
    from distributed import get_worker

    worker, words = get_worker(), shelf.words
    if "-t" not in words:
        words += ("-t", str(max(worker.state.nthreads, FEWEST_THREADS)))
    memory = worker.memory_manager.memory_limit or 0
    with _one_at_a_time:
        return replace(shelf, words=words).work(item, Processes(memory))


def _absolute(item: Item) -> Item:
    """Return an item whose paths mean the same in every working directory."""
    options = {
        name: str(Path(value).absolute()) if name in PATHS else value
        for name, value in item.options.items()
    }
    return replace(item, capture=item.capture.absolute(), options=options)

"""Captures as tasks of a cluster: a worker runs the commands of one capture at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any

from svu_mi.batch.listing import PATHS, Item
from svu_mi.batch.record import Outcome
from svu_mi.batch.shelf import Processes, Shelf
from svu_mi.limits import FEWEST_THREADS
from svu_mi.shards.cluster import require_workers

DAY = 86400.0  # seconds
_one_at_a_time = Lock()  # a worker has as many tasks at once as it has threads


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

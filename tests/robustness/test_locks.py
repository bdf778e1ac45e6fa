"""One writer at a time: in other processes, in other threads, and whatever lies there."""

from __future__ import annotations

import errno
import multiprocessing
import os
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from support.helpers import names
from support.letters import contents, write

from svu_mi.core.io import folder_exchange
from svu_mi.core.io.folder_exchange import DRAFT, locked
from svu_mi.core.io.output_folder import claimed
from svu_mi.errors import OutputError

OCCUPIED = "another svu is writing there; wait for it, or choose another folder"


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


def test_a_lock_ends_with_its_process(tmp_path, out):
    holder = multiprocessing.get_context("spawn")
    here, there = holder.Pipe()
    process = holder.Process(target=_hold, args=(out, there))
    process.start()
    assert here.recv() == "locked"
    with pytest.raises(OutputError, match=OCCUPIED), claimed(out, "render"):
        pass
    process.kill()
    process.join()
    with claimed(out, "render"):
        assert names(tmp_path) == [f".out{DRAFT}"]
    assert names(tmp_path) == []


def _hold(target: Path, pipe: Any) -> None:
    with locked(target):
        pipe.send("locked")
        threading.Event().wait()


def test_a_draft_removed_before_it_is_locked_is_made_again(out, monkeypatch):
    """Another writer ends between the two steps of a lock; a third must not get it, too."""
    lock = folder_exchange._lock

    def late(descriptor: int, target: Path) -> bool:
        monkeypatch.undo()
        out.with_name(f".out{DRAFT}").rmdir()
        return lock(descriptor, target)

    monkeypatch.setattr(folder_exchange, "_lock", late)
    with locked(out) as draft:
        assert draft.is_dir()
        with pytest.raises(OutputError, match=OCCUPIED), locked(out):
            pass


def test_another_thread_is_refused(out):
    refused = []

    def ask() -> None:
        try:
            with locked(out):
                pass
        except OutputError as error:
            refused.append(str(error))

    for expected in (1, 1):
        if not refused:
            with locked(out):
                _in_a_thread(ask)
        else:
            _in_a_thread(ask)
        assert len(refused) == expected


def _in_a_thread(work: Any) -> None:
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()


@pytest.mark.parametrize("exchange", [True, False])
@pytest.mark.parametrize("older", [True, False])
def test_a_writer_that_waits_sees_the_exchange(out, monkeypatch, exchange, older):
    """The folder that it waits for becomes the result, which it must not take for its draft."""
    if not exchange:
        monkeypatch.setattr("svu_mi.core.io.folder_exchange._exchange", lambda *_: False)
    if older:
        write(out, "o", ("a", "b"))
    entered, contents_seen = threading.Event(), []

    def wait() -> None:
        entered.set()
        with locked(out, wait=30) as draft:
            contents_seen.append((names(draft), contents(out)))

    waiting = threading.Thread(target=wait)
    with claimed(out, "recover") as place:
        waiting.start()
        entered.wait()
        waiting.join(0.2)
        assert not contents_seen
        write(place, "n", ("a",))
    waiting.join()
    assert contents_seen == [([], {"a": "n", "run.json": "n"})]
    assert names(out.parent) == ["out"]


def test_a_claim_does_not_clear_the_draft_of_the_next_writer(out):
    with ExitStack() as first, ExitStack() as second:
        write(first.enter_context(claimed(out, "recover")), "o", ("a",))
        place = second.enter_context(claimed(out, "recover"))  # the older draft is the result now
        (place.draft / "half").write_text("x")
        first.close()
        assert names(place.draft) == ["half"]


LAID = {
    "link": lambda draft: draft.symlink_to("keys"),
    "dangling link": lambda draft: draft.symlink_to("made"),
    "file": Path.touch,
    "pipe": os.mkfifo,
}


@pytest.mark.parametrize("lay", LAID.values(), ids=LAID)
def test_a_draft_that_a_stranger_has_laid_is_not_followed(tmp_path, out, lay):
    (tmp_path / "keys").mkdir()
    (tmp_path / "keys" / "key").write_text("mine")
    lay(tmp_path / f".out{DRAFT}")
    with pytest.raises(OutputError, match="svu cannot create its temporary folder next to it"):
        write(out, "n", ("a",))
    assert names(tmp_path) == [f".out{DRAFT}", "keys"] and names(tmp_path / "keys") == ["key"]


def test_results_are_written_where_locks_do_not_work(out, monkeypatch):
    said = []

    def unknown(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", unknown)
    # Not caplog: tests of commands before this one set up logging.
    monkeypatch.setattr(
        "svu_mi.core.io.folder_exchange.log.warning", lambda *words: said.append(words[0])
    )
    write(out, "o", ("a",))
    write(out, "n", ("a",))
    assert contents(out)["a"] == "n" and "locks are not supported there" in said[0]

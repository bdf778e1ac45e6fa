"""One writer at a time: in other processes, in other threads, and whatever lies there."""

from __future__ import annotations

import errno
import multiprocessing
import os
import threading
from pathlib import Path
from typing import Any

import pytest
from helpers import names
from trust.letters import write

from svu_mi.errors import OutputError
from svu_mi.results.lock import LOCK, locked
from svu_mi.results.writing import DRAFT, claimed


def test_one_writer_at_a_time(tmp_path):
    holder = multiprocessing.get_context("spawn")
    here, there = holder.Pipe()
    process = holder.Process(target=_hold, args=(tmp_path, there))
    process.start()
    assert here.recv() == "locked"
    message = rf"svu recover, process {process.pid} on \S+ is writing there; wait for it, or choose"
    with pytest.raises(OutputError, match=message), claimed(tmp_path, "svu render"):
        pass
    process.kill()  # its lock ends with it
    process.join()
    with claimed(tmp_path, "svu render"):
        assert LOCK in names(tmp_path)
    assert names(tmp_path) == []


def _hold(folder: Path, pipe: Any) -> None:
    with locked(folder, "svu recover"):
        pipe.send("locked")
        threading.Event().wait()


def test_a_thread_may_lock_again_and_another_may_not(tmp_path):
    refused = []

    def other() -> None:
        try:
            with locked(tmp_path, "other"):
                pass
        except OutputError as error:
            refused.append(str(error))

    def ask() -> None:
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()

    with locked(tmp_path, "one"), locked(tmp_path, "one"):
        ask()
    assert len(refused) == 1 and "another thread" in refused[0]
    ask()
    assert len(refused) == 1


LAID = {
    "link": lambda lock: lock.symlink_to("../keys"), "pipe": os.mkfifo, "folder": Path.mkdir,
    "hard link": lambda lock: lock.hardlink_to(lock.parent.parent / "keys"),
    "dangling": lambda lock: lock.symlink_to("../made"),
}  # fmt: skip


@pytest.mark.parametrize("lay", LAID.values(), ids=LAID)
def test_a_lock_that_a_stranger_has_laid_is_not_touched(tmp_path, lay):
    """It is a file that is written to, and removed."""
    folder, keys = tmp_path / "folder", tmp_path / "keys"
    folder.mkdir()
    keys.write_text("mine")
    lay(folder / LOCK)
    with pytest.raises(OutputError, match=r"cannot be locked for writing with .svu-lock \("):
        write(folder, "n", ("a",))
    assert keys.read_text() == "mine" and not (tmp_path / "made").exists()
    assert names(folder) == [LOCK]


def test_without_locks_nobody_s_draft_is_cleared(tmp_path, monkeypatch, caplog):
    def unknown(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", unknown)
    draft = tmp_path / f"{DRAFT}{'a' * 16}"
    draft.mkdir()
    write(tmp_path, "n", ("a",))
    assert draft.is_dir() and (tmp_path / "a").is_file()


def test_a_page_can_be_locked(tmp_path):
    with locked(tmp_path / "report.html", "one"):
        assert names(tmp_path) == [f".report.html{LOCK}"]
    assert names(tmp_path) == []

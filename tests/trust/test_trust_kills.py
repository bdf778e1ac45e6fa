"""Killed at any step, a command leaves the old result or the new one."""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers import names
from support.kills import COMMANDS, Place, killed, met, prepare
from trust.letters import contents, write

from svu_mi.files import write_text
from svu_mi.results.settling import READY, settle
from svu_mi.results.writing import claimed

KILLED = 9
STEPS = ("rename", "replace", "unlink", "mkdir", "rmdir")  # of Path, that change a folder
KILLS, PAIRS = 10, 3


def killed_at(step: int, work: Callable[[], Any]) -> bool:
    """Do something in another process that ends itself before its n-th change of a folder.

    Returns:
        Whether it got so far; if not, it has done all of its work.
    """
    pid = os.fork()
    if pid == 0:
        left = step

        def counted(change: Callable[..., Any]) -> Callable[..., Any]:
            def wrapper(*args: Any, **options: Any) -> Any:
                nonlocal left
                left -= 1
                if left < 0:
                    os._exit(KILLED)
                return change(*args, **options)

            return wrapper

        try:
            for name in STEPS:
                setattr(Path, name, counted(getattr(Path, name)))
            work()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == KILLED


def test_killed_at_any_step_leaves_the_old_result_or_the_new_one(tmp_path):
    """Never a mixture, never a loss; and the next reader sees a whole folder."""
    old_files, new_files = ("a", "b", "assets/c", "gone"), ("a", "b", "assets/c", "added")
    old = {**dict.fromkeys(old_files, "o"), "run.json": "o", "notes": "mine"}
    new = {**dict.fromkeys(new_files, "n"), "run.json": "n", "notes": "mine"}
    step, found = 0, []
    while True:
        folder = tmp_path / str(step)
        folder.mkdir()
        (folder / "notes").write_text("mine")
        write(folder, "o", old_files)
        stopped = killed_at(step, lambda at=folder: write(at, "n", new_files))
        settle(folder)
        with claimed(folder, "test"):  # the next command clears what is left
            pass
        assert contents(folder) in (old, new), step
        assert names(folder) == sorted({name.partition("/")[0] for name in contents(folder)})
        found.append(contents(folder) == new)
        # Completing what a killed run has left may be killed, too.
        if not stopped:
            break
        step += 1
    assert step > 15 and found == sorted(found) and any(found) and not all(found)


@pytest.mark.slow
def test_completing_can_be_killed_too(tmp_path):
    """A reader that is killed while it puts a result in its place leaves it to the next."""
    for first in range(40):
        folder = tmp_path / str(first)
        write(folder, "o", ("a", "b"))
        if not killed_at(first, lambda at=folder: write(at, "n", ("a", "b"))):
            break
        if not list(folder.glob(f"{READY}*")):
            continue
        second = 0
        while killed_at(second, lambda at=folder: settle(at)):
            second += 1
        with claimed(folder, "test"):  # removes the lock file of the last killed
            pass
        assert set(contents(folder).values()) == {"n"}


def test_a_single_file_is_the_old_or_the_new_one_too(tmp_path):
    """So are written: checkpoints, pages, caches and texture coordinates beside a capture."""
    path, step, found = tmp_path / "unwrapped.ply", 0, []
    stopped = True
    while stopped:
        path.write_text("old\n")
        stopped = killed_at(step, lambda: write_text(path, "new"))
        found.append(path.read_text())
        with claimed(tmp_path, "test"):
            pass
        assert names(tmp_path) == [path.name]
        step += 1
    assert set(found) == {"old\n", "new\n"} and found == sorted(found, reverse=True)


# --- whole commands, at random moments: a few of what ``support.kills`` makes hundreds of ------


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    at = tmp_path_factory.mktemp("kills")
    prepare(at)
    return [Place(name, at).begin() for name in COMMANDS]


@pytest.mark.slow
@pytest.mark.parametrize("index", range(KILLS))
def test_a_killed_command_leaves_the_old_result_or_the_new_one(places, index):
    place = places[index % len(places)]
    assert killed(place, random.Random(index), place.at / "again" / place.name) in ("old", "new")


@pytest.mark.slow
@pytest.mark.parametrize("index", range(PAIRS))
def test_of_two_commands_in_one_folder_one_writes(places, index):
    assert met(places[index], places[index].at / "again" / places[index].name) in ("one", "both")

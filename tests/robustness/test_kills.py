"""Killed at any step, a command leaves the old result or the new one."""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.helpers import names
from support.kills import COMMANDS, Place, killed, met, prepare
from support.letters import contents, write

from svu_mi.core.io import folder_exchange
from svu_mi.core.io.files import clear_temporaries, write_text
from svu_mi.core.io.folder_exchange import restore
from svu_mi.core.io.output_folder import claimed

KILLED = 9
STEPS = ("rename", "replace", "unlink", "mkdir", "rmdir")  # of Path, that change a folder
KILLED_COMMANDS, PAIRS = list(COMMANDS)[:4], 2


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
            setattr(folder_exchange, "_exchange", counted(folder_exchange._exchange))  # noqa: B010
            os.unlink = counted(os.unlink)  # what shutil.rmtree removes files with
            work()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == KILLED


@pytest.mark.few(2)
@pytest.mark.parametrize("next_is", ["a reader", "a writer"])
@pytest.mark.parametrize("atomic", [True, False], ids=["exchange", "two renames"])
@pytest.mark.parametrize("others", [False, True], ids=["own", "others"])
def test_kill_at_any_step_leaves_old_or_new_result(tmp_path, monkeypatch, next_is, atomic, others):
    if not atomic:
        monkeypatch.setattr(folder_exchange, "_exchange", lambda *_: False)
    old_files, new_files = ("a", "b", "assets/c", "gone"), ("a", "b", "assets/c", "added")
    old = {**dict.fromkeys(old_files, "o"), "run.json": "o"} | ({"mine": "x"} if others else {})
    new = {**dict.fromkeys(new_files, "n"), "run.json": "n"}
    step, states, stopped = 0, [], True

    def work(out: Path) -> None:
        with claimed(out, "recover", overwrite=others) as place:
            write(place, "n", new_files)

    while stopped:
        out = tmp_path / str(step) / "out"
        write(out, "o", old_files)
        if others:
            (out / "mine").write_text("x")
        stopped = killed_at(step, lambda at=out: work(at))
        restore(out) if next_is == "a reader" else None
        with claimed(out, "recover", overwrite=True):  # the next run clears what is left
            pass
        assert contents(out) in (old, new), step
        assert not [name for name in names(out.parent) if name.startswith(".")], step
        if others:
            assert old in [contents(path) for path in out.parent.iterdir()], step
        states.append(contents(out) == new)
        step += 1
    assert step > 10 and states == sorted(states) and any(states) and not all(states)


def test_a_single_file_is_the_old_or_the_new_one_too(tmp_path):
    """So are written: checkpoints, pages, caches and texture coordinates beside a capture."""
    path, step, texts = tmp_path / "unwrapped.ply", 0, []
    stopped = True
    while stopped:
        path.write_text("old\n")
        stopped = killed_at(step, lambda: write_text(path, "new"))
        texts.append(path.read_text())
        clear_temporaries(tmp_path)
        assert names(tmp_path) == [path.name]
        step += 1
    assert set(texts) == {"old\n", "new\n"} and texts == sorted(texts, reverse=True)


# --- commands, at random moments: a few of what ``support.kills`` makes many of ----------------


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    at = tmp_path_factory.mktemp("kills")
    prepare(at, KILLED_COMMANDS)
    return [Place(name, at).begin() for name in KILLED_COMMANDS]


@pytest.mark.slow
@pytest.mark.parametrize("index", range(len(KILLED_COMMANDS)))
def test_a_killed_command_leaves_the_old_result_or_the_new_one(places, index):
    place = places[index]
    atomic = index % 2 == 0
    assert killed(place, random.Random(index), place.at / "again" / place.name, atomic) in (
        "old", "new"
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("index", range(PAIRS))
def test_of_two_commands_in_one_folder_one_writes(places, index):
    assert met(places[index], places[index].at / "again" / places[index].name) in ("one", "both")

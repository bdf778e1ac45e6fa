"""Results in their folders: whole at any moment, one writer, nobody else's files lost."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import names

from svu_mi.errors import CaptureError, OutputError, SvuWarning
from svu_mi.exr import read_attributes, write_exr
from svu_mi.files import replacing, stamp, stamped, write_json, write_text
from svu_mi.results.lock import LOCK, locked
from svu_mi.results.reading import are_of_one_capture, marks_of, require_one_run
from svu_mi.results.record import entries, is_inside
from svu_mi.results.settling import JOURNAL, READY, names_in, settle
from svu_mi.results.writing import DRAFT, claimed, exchanging, require_own, writing

KILLED = 9
STEPS = ("rename", "replace", "unlink", "mkdir", "rmdir")  # of Path, that change a folder


def write(folder: Path, letter: str, files: tuple[str, ...], command: str = "recover") -> str:
    """Write a result whose files all hold one letter; return its id."""
    with writing(folder, command, "run.json", capture=letter * 8) as draft:
        for name in files:
            (draft.folder / name).parent.mkdir(exist_ok=True)
            write_text(draft.folder / name, letter)
        write_json(draft.folder / "run.json", {"letter": letter, **draft.entries()})
    return draft.run


def contents(folder: Path) -> dict[str, str]:
    """Return the letter in each file of a folder but the record, and the record's."""
    found = {name: (folder / name).read_text().strip() for name in names_in(folder)}
    if "run.json" in found:
        found["run.json"] = json.loads(found["run.json"])["letter"]
    return found


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


def test_a_failed_run_leaves_what_was_there(tmp_path):
    write(tmp_path, "o", ("a", "b"))
    before = contents(tmp_path)
    with pytest.raises(ZeroDivisionError), writing(tmp_path, "recover", "run.json") as draft:
        write_text(draft.folder / "a", "n")
        1 / 0  # noqa: B018
    assert contents(tmp_path) == before and names(tmp_path) == ["a", "b", "run.json"]


def test_a_folder_made_for_nothing_is_removed(tmp_path):
    with pytest.raises(ZeroDivisionError), exchanging(tmp_path / "out", "import", "run.json"):
        1 / 0  # noqa: B018
    assert names(tmp_path) == []


def test_files_of_others_are_kept(tmp_path):
    (tmp_path / "a").write_text("mine")
    with pytest.warns(SvuWarning, match=r": a, not written by .* or changed since, is kept as a"):
        write(tmp_path, "o", ("a",))
    assert contents(tmp_path) == {"a": "o", "a.before": "mine", "run.json": "o"}
    (tmp_path / "a").write_text("edited")
    with pytest.warns(SvuWarning, match=r"kept as a.before1"):
        write(tmp_path, "n", ("a",))
    assert contents(tmp_path) == {
        "a": "n", "a.before": "mine", "a.before1": "edited", "run.json": "n"
    }  # fmt: skip


def test_edited_files_of_an_older_result_are_not_removed(tmp_path):
    write(tmp_path, "o", ("a", "b", "c"))
    (tmp_path / "b").write_text("edited")
    write(tmp_path, "n", ("a",))
    assert contents(tmp_path) == {"a": "n", "b": "edited", "run.json": "n"}


def test_results_of_several_commands_share_a_folder(tmp_path):
    first = write(tmp_path, "e", ("map", "page"), "entropy")
    second = write(tmp_path, "r", ("map", "texture"), "recover")
    found = entries(tmp_path / "run.json")
    assert [(e.command, e.run, sorted(e.files)) for e in found] == [
        ("recover", second, ["map", "texture"]), ("entropy", first, ["page"])
    ]  # fmt: skip
    write(tmp_path, "n", ("map", "page"), "entropy")
    assert contents(tmp_path) == {"map": "n", "page": "n", "texture": "r", "run.json": "n"}


def test_a_folder_of_its_own(tmp_path):
    """What render and import ask of theirs."""
    require_own(tmp_path, "render", "run.json")
    write(tmp_path, "o", ("view",), "render")
    (tmp_path / "cache").write_text("x")
    require_own(tmp_path, "render", "run.json", ["cache"])
    with pytest.raises(OutputError, match=r"cache was not written by svu render, or by an ol"):
        require_own(tmp_path, "render", "run.json")
    with pytest.raises(OutputError, match="was not written by svu import"):
        require_own(tmp_path, "import", "run.json", ["cache"])
    (tmp_path / "view").write_text("mine")
    with pytest.raises(OutputError, match="view was changed since svu render wrote it"):
        require_own(tmp_path, "render", "run.json", ["cache"])


def test_the_record_of_a_stranger_frees_nothing(tmp_path):
    """A folder with a record of its own making, as of ours, keeps its files."""
    (tmp_path / "view").write_text("mine")
    record = {"written": {"run": "0", "command": "render", "capture": "", "files": {"view": "00"}}}
    for files in ({"view": "00"}, {"../view": "00"}, ["view"], None, {"view": None}):
        record["written"]["files"] = files
        (tmp_path / "run.json").write_text(json.dumps(record))
        with pytest.raises(OutputError, match="was not written|was changed since"):
            require_own(tmp_path, "render", "run.json")


OUTSIDE = ["../a", "/a", "a/../../b", "", ".", "a\n", "a\\b", "c:a", None, 1]


@pytest.mark.parametrize("name", OUTSIDE)
def test_names_that_leave_the_folder_are_none(name):
    assert not is_inside(name)
    assert is_inside("assets/a.exr")


@pytest.mark.parametrize("key", ["remove", "keep", "kept as", "link", "moved", "kept link"])
def test_a_journal_of_a_stranger_touches_nothing_outside(tmp_path, key):
    """A reader completes what it finds, but never beyond the folder."""
    outside, folder = tmp_path / "outside", tmp_path / "folder"
    outside.mkdir()
    (outside / "a").write_text("mine")
    ready = folder / f"{READY}{'0' * 16}"
    ready.mkdir(parents=True)
    (ready / "run.json").write_text("{}")
    journal = {"record": "run.json", "remove": [], "keep": {}}
    if key == "remove":
        journal["remove"] = ["../outside/a"]
    elif key == "keep":
        journal["keep"] = {"../outside/a": "b"}
    elif key == "kept as":
        (folder / "run.json").write_text("x")
        journal["keep"] = {"run.json": "../outside/a"}
    else:
        name = "x" if key == "kept link" else "assets"
        (folder / name).symlink_to(outside)
        journal["remove"] = ["assets/a"] if key != "moved" else []
        if key == "kept link":  # a link that only the journal puts in the way
            journal["keep"] = {"x": "assets"}
            (ready / "x").write_text("x")
        (ready / "assets").mkdir()
        (ready / "assets" / "a").write_text("evil")
    (ready / JOURNAL).write_text(json.dumps(journal))
    wrong = r"journal.json is not one of svu; remove this folder|leads elsewhere; remove the hid"
    with pytest.raises(OutputError, match=wrong):
        settle(folder)
    assert (outside / "a").read_text() == "mine" and names(outside) == ["a"]


def test_what_killed_runs_have_left_is_cleared(tmp_path):
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"],
                          capture_output=True, text=True, check=True).stdout.strip()  # fmt: skip
    draft = tmp_path / f"{DRAFT}{'a' * 16}"
    draft.mkdir()
    (draft / "half").write_text("x")
    with replacing(tmp_path / "page.html") as temporary:
        alive = temporary.name
    mine = f"-{os.getpid()}-"
    stale, elsewhere = alive.replace(mine, f"-{dead}-"), f".page.00000000-{dead}-0123abcd.tmp.html"
    assert mine in alive
    for name in (stale, alive, elsewhere, ".page.tmp.html", f"{DRAFT}mine"):
        (tmp_path / name).write_text("x")
    with claimed(tmp_path, "test"):
        pass
    left = [alive, elsewhere, ".page.tmp.html", f"{DRAFT}mine", "page.html"]
    assert names(tmp_path) == sorted(left)  # of another machine nothing is known


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


@pytest.mark.parametrize("kind", ["link", "hard link", "dangling", "pipe", "folder"])
def test_a_lock_that_a_stranger_has_laid_is_not_touched(tmp_path, kind):
    """It is a file that is written to, and removed."""
    folder, keys = tmp_path / "folder", tmp_path / "keys"
    folder.mkdir()
    keys.write_text("mine")
    lock = folder / LOCK
    match kind:
        case "link":
            lock.symlink_to(keys)
        case "hard link":
            lock.hardlink_to(keys)
        case "dangling":
            lock.symlink_to(tmp_path / "made")
        case "pipe":
            os.mkfifo(lock)
        case "folder":
            lock.mkdir()
    with pytest.raises(OutputError, match=r"cannot be locked for writing by .svu-lock \("):
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
    assert draft.is_dir() and (tmp_path / "a").read_text() == "n\n"


def test_what_is_in_the_way_of_a_folder_is_kept(tmp_path):
    """A file, or a link to another disk, where the result has a folder."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "assets").symlink_to(tmp_path / "disk")
    (tmp_path / "out" / "textures").write_text("mine")
    with pytest.warns(SvuWarning, match=r"kept as assets.before \(and 1 more likewise\)"):
        write(tmp_path / "out", "n", ("assets/a", "assets/b", "textures/c"))
    assert names(tmp_path / "disk") == []
    assert names(tmp_path / "out") == [
        "assets", "assets.before", "run.json", "textures", "textures.before"
    ]  # fmt: skip
    assert (tmp_path / "out" / "assets.before").is_symlink()
    write(tmp_path / "out", "n", ("assets/a", "textures/c"))
    assert names_in(tmp_path / "out") == [
        "assets.before", "assets/a", "run.json", "textures.before", "textures/c"
    ]  # fmt: skip


def test_a_result_that_cannot_be_moved_is_not_lost(tmp_path, monkeypatch):
    write(tmp_path, "o", ("a", "b"))

    def refused(self: Path, target: Path) -> Path:
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", refused)
        with pytest.raises(OutputError, match=r"the result is complete in .svu-ready-\w+, but can"):
            write_without_replacing(tmp_path)
    settle(tmp_path)
    assert contents(tmp_path) == {"a": "n", "b": "n", "run.json": "n"}


def write_without_replacing(folder: Path) -> None:
    with writing(folder, "recover", "run.json") as draft:
        for name in ("a", "b"):
            (draft.folder / name).write_text("n\n")
        record = {"letter": "n", **draft.entries()}
        (draft.folder / "run.json").write_text(json.dumps(record))


def test_files_of_another_command_in_the_folder_are_known(tmp_path):
    """Two that take turns do not keep each other's files for ever."""
    for _ in range(3):
        write(tmp_path, "r", ("mesh",))
        with writing(tmp_path, "export", "asset.json") as draft:
            write_text(draft.folder / "mesh", "e")
            write_json(draft.folder / "asset.json", {"letter": "e", **draft.entries()})
    assert names(tmp_path) == ["asset.json", "mesh", "run.json"]


def test_a_page_can_be_locked(tmp_path):
    with locked(tmp_path / "report.html", "one"):
        assert names(tmp_path) == [f".report.html{LOCK}"]
    assert names(tmp_path) == []


def test_files_have_the_marks_of_their_run(tmp_path):
    with stamped({"svu:run": "12ab", "svu:capture": "34cd"}):
        write_exr(tmp_path / "a.exr", {"Y": np.zeros((2, 2))}, {"svu:method": "sh"})
        (tmp_path / "a.xml").write_text(f"<!-- {' '.join(f'{k}={v}' for k, v in stamp().items())}")
    write_exr(tmp_path / "b.exr", {"Y": np.zeros((2, 2))})
    assert read_attributes(tmp_path / "a.exr")["svu:method"] == "sh"
    assert marks_of(tmp_path / "a.exr") == marks_of(tmp_path / "a.xml") == ("12ab", "34cd")
    assert marks_of(tmp_path / "b.exr") == ("", "")


def test_readers_refuse_files_of_two_runs(tmp_path):
    def marked(name: str, run: str, capture: str = "") -> None:
        with stamped({"svu:run": run, "svu:capture": capture}):
            write_exr(tmp_path / name, {"Y": np.zeros((2, 2))})

    marked("a.exr", "12ab", "01")
    marked("b.exr", "12ab", "01")
    write_exr(tmp_path / "mine.exr", {"Y": np.zeros((2, 2))})
    files = ["a.exr", "b.exr", "mine.exr"]
    require_one_run(tmp_path, files, "run.json", "recover")
    marked("b.exr", "34cd", "02")
    with pytest.raises(CaptureError, match=r"a.exr and b.exr are of different runs; take both"):
        require_one_run(tmp_path, files, "run.json", "recover")
    assert not are_of_one_capture(tmp_path / "a.exr", tmp_path / "b.exr")
    assert are_of_one_capture(tmp_path / "a.exr", tmp_path / "mine.exr")
    entry = {"run": "56ef", "command": "recover", "capture": "", "files": {}}
    write_json(tmp_path / "run.json", {"written": entry})
    with pytest.raises(CaptureError, match=r"a.exr and run.json are of different runs"):
        require_one_run(tmp_path, ["a.exr"], "run.json", "recover")

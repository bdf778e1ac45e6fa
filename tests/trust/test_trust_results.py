"""Results in their folders: whole at any moment, one writer, nobody else's files lost."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import names
from trust.letters import contents, write

from svu_mi.errors import OutputError, SvuWarning
from svu_mi.files import replacing, write_json, write_text
from svu_mi.results.keeping import write_alone
from svu_mi.results.record import entries, is_inside
from svu_mi.results.settling import JOURNAL, READY, names_in, settle
from svu_mi.results.writing import DRAFT, claimed, exchanging, require_own, writing


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


def test_a_page_of_others_or_an_edited_one_is_kept(tmp_path):
    page = tmp_path / "report.html"
    page.write_text("mine")
    with pytest.warns(SvuWarning) as said:
        write_alone(page, "<p>first")
    assert [str(warning.message) for warning in said] == [
        f"{tmp_path}: report.html, not written by this version of svu or changed since, is kept as "
        "report.before.html; remove it when you no longer need it."
    ]
    write_alone(page, "<p>second")  # over one's own, without a word
    assert names(tmp_path) == ["report.before.html", "report.html"]
    page.write_text(page.read_text().replace("second", "edited"))
    with pytest.warns(SvuWarning, match="is kept as report.before1.html"):
        write_alone(page, "<p>third")
    found = contents(tmp_path)
    assert found["report.before.html"] == "mine"
    assert found["report.before1.html"].startswith("<p>edited\n<!-- svu:page=")
    assert found["report.html"].startswith("<p>third\n<!-- svu:page=")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_bytes(page.read_bytes())
    page.unlink()
    page.symlink_to(elsewhere)
    with pytest.warns(SvuWarning, match="is kept as report.before2.html"):
        write_alone(page, "<p>fourth")
    assert (tmp_path / "report.before2.html").is_symlink() and not page.is_symlink()
    assert elsewhere.read_text().startswith("<p>third")


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


JOURNALS = {  # and a link in the folder that leads outside
    "removed": ({"remove": ["../outside/a"]}, ""),
    "kept": ({"keep": {"../outside/a": "b"}}, ""),
    "kept as": ({"keep": {"run.json": "../outside/a"}}, ""),
    "removed behind a link": ({"remove": ["assets/a"]}, "assets"),
    "moved behind a link": ({}, "assets"),
    "a link that the journal puts in the way": ({"keep": {"x": "assets"}}, "x"),
}


@pytest.mark.parametrize(("journal", "link"), JOURNALS.values(), ids=JOURNALS)
def test_a_journal_of_a_stranger_touches_nothing_outside(tmp_path, journal, link):
    """A reader completes what it finds, but never beyond the folder."""
    outside, folder = tmp_path / "outside", tmp_path / "folder"
    ready = folder / f"{READY}{'0' * 16}"
    outside.mkdir()
    (ready / "assets").mkdir(parents=True)
    (outside / "a").write_text("mine")
    (ready / "run.json").write_text("{}")
    write_json(ready / JOURNAL, {"record": "run.json", "remove": [], "keep": {}, **journal})
    if link:
        (folder / link).symlink_to(outside)
        (ready / link).touch() if link == "x" else None
        (ready / "assets" / "a").write_text("evil")
    wrong = r"journal.json was not written by svu; remove this|leads out of the folder; remove"
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

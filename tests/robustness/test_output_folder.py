"""Results in their folders: complete at any moment, and nobody else's files are lost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.helpers import names
from support.letters import contents, write

from svu_mi.core.io import output_folder
from svu_mi.core.io.files import clear_temporaries, replacing, write_text
from svu_mi.core.io.folder_exchange import DRAFT
from svu_mi.core.io.output_folder import claimed, require_own_page, write_page, writing
from svu_mi.core.io.provenance import is_inside
from svu_mi.errors import OutputError, SvuWarning


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


def test_a_failed_run_leaves_what_was_there(tmp_path, out):
    write(out, "o", ("a", "b"))
    before = contents(out)
    with pytest.raises(ZeroDivisionError), writing(out, "recover", "run.json") as draft:
        write_text(draft.folder / "a", "n")
        1 / 0  # noqa: B018
    assert contents(out) == before and names(tmp_path) == ["out"]


def test_no_file_stays_open(tmp_path, out):
    write(out, "o", ("a", "b"))
    write(out, "n", ("a",))
    with pytest.raises(OutputError, match="is a folder"):
        write_text(out, "n")
    opened = (os.path.realpath(f"/proc/self/fd/{number}") for number in os.listdir("/proc/self/fd"))
    assert not [path for path in opened if path.startswith(str(tmp_path))]


def test_a_draft_may_lose_files_meanwhile(out):
    with claimed(out, "import") as place:
        (place.draft / "a").write_text("o")
        place.clear(lambda path: path.unlink())  # as a cleaner of temporary files does
        assert names(place.draft) == []


def test_a_folder_made_for_nothing_is_removed(tmp_path):
    with pytest.raises(ZeroDivisionError), claimed(tmp_path / "a" / "b" / "out", "import"):
        1 / 0  # noqa: B018
    assert names(tmp_path) == []


def test_a_result_replaces_all_of_the_older_one(tmp_path, out):
    first = write(out, "o", ("a", "assets/b"))
    second = write(out, "n", ("a", "c"))
    assert first != second and contents(out) == {"a": "n", "c": "n", "run.json": "n"}
    assert names(tmp_path) == ["out"]


SPOILED = {
    "another file": lambda out: (out / "notes").write_text("mine"),
    "an edited file": lambda out: (out / "a").write_text("mine"),
    "a link": lambda out: (out / "link").symlink_to(out.parent),
    "another command": lambda out: write(out, "o", ("map",), "entropy"),
}


@pytest.mark.parametrize("spoil", SPOILED.values(), ids=SPOILED)
def test_a_folder_with_other_files_is_refused_or_kept(tmp_path, out, spoil):
    if spoil is not SPOILED["another command"]:
        write(out, "o", ("a", "b"))
    spoil(out)
    before = contents(out) if not (out / "link").is_symlink() else names(out)
    with pytest.raises(OutputError, match=r"contains other files: .*; choose another name, or"):
        write(out, "n", ("a",))
    with (
        pytest.warns(SvuWarning, match=r"the older content is kept as out.before;"),
        claimed(out, "recover", overwrite=True) as place,
    ):
        write(place, "n", ("a",))
    assert contents(out) == {"a": "n", "run.json": "n"} and names(tmp_path) == ["out", "out.before"]
    kept = tmp_path / "out.before"
    assert before == (contents(kept) if not (kept / "link").is_symlink() else names(kept))
    (out / "b").write_text("mine")
    with pytest.warns(SvuWarning), claimed(out, "recover", overwrite=True) as place:
        write(place, "n", ("a",))
    assert names(tmp_path) == ["out", "out.before", "out.before1"]


def test_a_link_to_equal_contents_is_not_ours(tmp_path, out):
    write(out, "o", ("a",))
    (out / "a").rename(tmp_path / "mine")
    (out / "a").symlink_to(tmp_path / "mine")
    with pytest.raises(OutputError, match="a was changed since svu recover wrote it"):
        write(out, "n", ("a",))
    assert (out / "a").is_symlink()


def test_a_file_that_is_edited_during_a_run_is_kept(tmp_path, out):
    write(out, "o", ("a",))
    with pytest.warns(SvuWarning, match="kept as out.before"), claimed(out, "recover") as place:
        (out / "a").write_text("mine")
        write(place, "n", ("a",))
    assert contents(out)["a"] == "n" and (tmp_path / "out.before" / "a").read_text() == "mine"


@pytest.mark.parametrize("exchange", [True, False])
def test_light_and_uvs_in_a_folder_survive_its_result(out, monkeypatch, exchange):
    if not exchange:
        monkeypatch.setattr("svu_mi.core.io.folder_exchange._exchange", lambda *_: False)
    write(out, "o", ("view",), "render")
    (out / "light").mkdir()
    (out / "light" / "light.exr").write_text("found")
    (out / "unwrapped.ply").write_text("laid out")
    write(out, "n", ("view",), "render")
    assert contents(out) == {
        "light/light.exr": "found", "unwrapped.ply": "laid out", "view": "n", "run.json": "n"
    }  # fmt: skip


def test_files_of_killed_runs_are_cleared(tmp_path, out):
    write(out, "o", ("a",))
    (tmp_path / f".out{DRAFT}" / "light").mkdir(parents=True)  # a kill after the exchange
    (tmp_path / f".out{DRAFT}" / "half").write_text("x")
    with claimed(out, "recover") as place:
        assert names(place.draft) == []
    assert names(tmp_path) == ["out"] and names(out) == ["a", "light", "run.json"]


def test_only_temporary_files_of_dead_processes_are_cleared(tmp_path):
    program = (
        "import os, sys; from svu_mi.core.io.files import replacing; from pathlib import Path\n"
        "with replacing(Path(sys.argv[1]) / 'page.html'): os._exit(9)"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=False)
    (tmp_path / ".mine.tmp").write_text("x")
    (tmp_path / ".link.svu-tmp").symlink_to(".mine.tmp")
    os.mkfifo(tmp_path / ".pipe.svu-tmp")
    assert len(names(tmp_path)) == 4
    with replacing(tmp_path / "other.html") as alive:
        clear_temporaries(tmp_path)
        left = {alive.name, ".mine.tmp", ".link.svu-tmp"}
        assert left <= set(names(tmp_path)) <= left | {".pipe.svu-tmp"}


def test_foreign_record_allows_no_deletion(out):
    """A folder with a record of its own making, as of ours, keeps its files."""
    out.mkdir()
    (out / "view").write_text("mine")
    record = {"written": {"run": "0", "command": "recover", "capture": "", "files": {"view": "0"}}}
    for files in ({"view": "00"}, {"../view": "00"}, ["view"], None, {"view": None}):
        record["written"]["files"] = files
        (out / "run.json").write_text(json.dumps(record))
        with pytest.raises(OutputError, match="was not written|was changed since"):
            write(out, "n", ("view",))


OUTSIDE = ["../a", "/a", "a/../../b", "", ".", "a\n", "a\\b", "c:a", None, 1]


@pytest.mark.parametrize("name", OUTSIDE)
def test_names_outside_the_folder_are_refused(name):
    assert not is_inside(name)
    assert is_inside("assets/a.exr")


# --- places that results cannot be put in, or can ----------------------------------------------


def test_a_link_to_a_folder_stays_one(tmp_path):
    disk = tmp_path / "disk"
    write(disk, "o", ("a",))
    (tmp_path / "out").symlink_to(disk)
    write(tmp_path / "out", "n", ("a",))
    assert contents(disk)["a"] == "n" and (tmp_path / "out").is_symlink()
    assert names(tmp_path) == ["disk", "out"]


def test_the_working_directory_is_refused(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for place in (".", "..", tmp_path / "here"):
        with pytest.raises(OutputError, match="contains the working directory and cannot be rep"):
            write(place, "n", ("a",))
    write("out", "n", ("a",))
    assert names(tmp_path / "here") == ["out"]


@pytest.mark.parametrize("place", ["/", "a disk"])
def test_a_mounted_folder_is_refused(out, monkeypatch, place):
    monkeypatch.setattr(output_folder, "_mounts", lambda: {str(out)})
    with pytest.raises(OutputError, match="cannot be replaced by a result; choose a folder"):
        write(Path("/") if place == "/" else out, "n", ("a",))


def test_a_file_in_the_way_is_refused(out):
    out.write_text("mine")
    with pytest.raises(OutputError, match="is a file, not a folder; choose another folder"):
        write(out, "n", ("a",))
    with pytest.raises(OutputError, match="is a file, not a folder"):
        write(out / "below", "n", ("a",))
    assert out.read_text() == "mine"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
@pytest.mark.parametrize("which", ["parent", "target"])
def test_a_folder_that_is_read_only_is_refused(tmp_path, out, which):
    write(out, "o", ("a",))
    place = tmp_path if which == "parent" else out
    place.chmod(0o555)
    try:
        with pytest.raises(OutputError, match=r"no file can be written there \(Permission denied"):
            write(out, "n", ("a",))
    finally:
        place.chmod(0o755)
    assert contents(out)["a"] == "o"


# --- a page that lies alone ---------------------------------------------------------------------


def test_a_page_of_others_or_an_edited_one_is_kept(tmp_path):
    page = tmp_path / "report.html"
    page.write_text("mine")
    with pytest.raises(OutputError, match="was not written by svu report, or was changed since"):
        require_own_page(page)
    with pytest.warns(SvuWarning, match=r"the older content is kept as report.html.before; remove"):
        write_page(page, "<p>first")
    require_own_page(page)
    write_page(page, "<p>second")  # over one's own, without a word
    assert names(tmp_path) == ["report.html", "report.html.before"]
    page.write_text(page.read_text().replace("second", "edited"))
    with pytest.warns(SvuWarning, match="is kept as report.html.before1"):
        write_page(page, "<p>third")
    pages = contents(tmp_path)
    assert pages["report.html.before"] == "mine"
    assert pages["report.html.before1"].startswith("<p>edited\n<!-- svu:page=")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_bytes(page.read_bytes())
    page.unlink()
    page.symlink_to(elsewhere)
    with pytest.warns(SvuWarning, match="is kept as report.html.before2"):
        write_page(page, "<p>fourth")
    assert (tmp_path / "report.html.before2").is_symlink() and not page.is_symlink()
    assert elsewhere.read_text().startswith("<p>third")

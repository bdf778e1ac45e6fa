"""``svu batch``: lists, cached steps, failures, interruptions, and the page."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.helpers import fails, run

from svu_mi import scenes
from svu_mi.cli.batch import batch_page
from svu_mi.cli.batch.batch_page import write_index
from svu_mi.cli.batch.capture_list import BatchItem, read_list, require_separate
from svu_mi.cli.batch.child_process import end_with_parent
from svu_mi.cli.batch.runner import (
    BatchRunner,
    CommandPool,
    Outcome,
    ProcessResult,
    last_sentence,
    work_on_cluster,
)
from svu_mi.cli.batch.steps import STEPS, command_words, read_done, step_key, write_done
from svu_mi.cli.main import parse
from svu_mi.cli.shared_options import as_dict
from svu_mi.core.io.exr import read_exr
from svu_mi.errors import CaptureError, OptionError

SMALL = ("--resolution", 16, "-t", 2)


@pytest.fixture
def shelf_of(shot, tmp_path):
    """Return a function that makes a folder of copies of a capture."""

    def made(*names):
        for name in names:
            folder = shutil.copytree(shot, tmp_path / "shelf" / name)
            record = json.loads((folder / "capture.json").read_text())
            record["scene"] = str(scenes.path("vase"))  # not relative to the copy
            (folder / "capture.json").write_text(json.dumps(record))
        return tmp_path / "shelf"

    return made


def table(folder: Path, *lines: str) -> Path:
    path = folder / "list.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


# --- lists ------------------------------------------------------------------------------------


def test_a_folder_of_captures_and_a_table_name_the_same(shelf_of, tmp_path):
    folder = shelf_of("b", "a")
    (folder / "notes").mkdir()
    assert [item.name for item in read_list(folder)] == ["a", "b"]
    head = "capture, name, resolution, light"
    path = table(tmp_path, head, "shelf/b,,32 16", "shelf/a, first,, l.exr,,", "")
    items = read_list(path)
    assert [item.name for item in items] == ["b", "first"]
    assert items[0].options == {"resolution": "32 16"}
    assert items[1].options == {"light": str(tmp_path / "l.exr")}


@pytest.mark.parametrize(("lines", "sentence"), [
    (["capture,colour", "shelf/a,red"], "has the column 'colour'; its first line must name"),
    (["name", "a"], "has other columns"),
    (["capture", "shelf/c"], "line 2: 'shelf/c' is not a capture"),
    (["capture,name", "shelf/a,../b"], "line 2: '../b' is not a valid folder name"),
    (["capture,name", "shelf/a,x", "shelf/a,X"], "the capture name 'X' is used twice; rename"),
    (["capture"], "contains no captures; expected one row per capture"),
    (["capture,resolution", "shelf/a,16 --trust"], "line 2: '16 --trust' is not a resolution"),
    (["capture,resolution", "shelf/a,16 8 4"], "line 2: '16 8 4' is not a resolution"),
    (["capture,resolution", "shelf/a,0"], "list.csv, line 2: '0' is not a resolution"),
    (["capture,light", "shelf/a", "shelf/a,my,.exr"], "line 3: '.exr' is in no column; put a cell"),
])  # fmt: skip
def test_what_a_table_cannot_say_is_a_sentence(shelf_of, tmp_path, lines, sentence):
    shelf_of("a")
    with pytest.raises((CaptureError, OptionError), match=".*") as caught:
        read_list(table(tmp_path, *lines))
    assert sentence in str(caught.value)


def test_a_list_that_is_not_there_and_steps_that_need_others(tmp_path, capsys):
    assert "no such folder or table" in fails(capsys, "batch", tmp_path / "x", "-o", tmp_path / "o")
    words = ("batch", tmp_path, "--steps", "export", "-o", tmp_path / "o")
    assert "needs the textures of recover" in fails(capsys, *words)
    for workers in (2, 3):
        words = ("batch", tmp_path, "--scheduler", "x:1", "--workers", workers)
        assert "has no effect with --scheduler" in fails(capsys, *words, "-o", tmp_path / "o")


def test_results_inside_captures_are_refused(shelf_of, tmp_path, capsys):
    shelf = shelf_of("a", "b")
    (tmp_path / "scenes" / "vase").mkdir(parents=True)
    shutil.copy(scenes.path("vase"), tmp_path / "scenes" / "vase")
    (tmp_path / "link").symlink_to(shelf)
    swapped = table(tmp_path, "capture,name", "shelf/a,b")
    (tmp_path / "photos" / "c").mkdir(parents=True)
    lists = tmp_path / "lists"
    lists.mkdir()
    taken = table(lists, "capture,name,images", "../shelf/a,c,../photos/c")
    before = set(tmp_path.rglob("*"))
    for captures, output in (
        (shelf, shelf), (shelf, shelf / "b"), (shelf, shelf / "b" / "out"), (shelf / ".", shelf),
        (shelf, tmp_path / "link"), (swapped, shelf / "a"), (taken, tmp_path / "photos"),
        (tmp_path / "scenes", tmp_path / "scenes"),
    ):  # fmt: skip
        said = fails(capsys, "batch", captures, "-o", output)
        assert "overlap the files of the capture" in said and "another folder with -o" in said
    assert set(tmp_path.rglob("*")) == before
    require_separate(shelf / "out", read_list(shelf))
    require_separate(tmp_path / "scenes" / "vase", read_list(tmp_path / "scenes"))


# --- steps ------------------------------------------------------------------------------------


class Made(CommandPool):
    """Command pool that writes only the proof of a step, and counts commands."""

    def __init__(self, statuses=()):
        super().__init__()
        self.lines, self.statuses = [], list(statuses)

    def run(self, words):
        self.lines.append([str(word) for word in words])
        status = self.statuses.pop(0) if self.statuses else 0
        if status == 0:
            folder = Path(words[words.index("-o") + 1]).parent
            step = STEPS[words[0]]
            (folder / step.proof).parent.mkdir(parents=True, exist_ok=True)
            (folder / step.proof).write_text("{}")
        return ProcessResult(status, "went wrong" if status > 0 else "", 5)


def test_steps_are_made_once_and_again_if_anything_changed(shelf_of, tmp_path, monkeypatch):
    item = BatchItem("a", shelf_of("a") / "a")
    shelf = BatchRunner(output=tmp_path / "out", options={"resolution": "16"})

    assert steps_made(shelf, item) == list(STEPS)
    assert steps_made(shelf, item) == []
    other = BatchRunner(output=shelf.output, options=shelf.options, words=("-t", "3"))
    assert steps_made(other, item) == []
    (tmp_path / "out" / "a" / "recovered" / "run.json").unlink()
    assert steps_made(shelf, item) == ["recover"]
    os.utime(item.capture / "view_0002.exr")
    assert steps_made(shelf, item) == list(STEPS)
    assert steps_made(shelf, BatchItem("a", item.capture, {"preset": "fast"})) == list(STEPS)
    assert steps_made(shelf, item) == list(STEPS)
    monkeypatch.setattr("svu_mi.cli.batch.steps.__version__", "0.0")
    assert steps_made(shelf, item) == list(STEPS)
    (tmp_path / "out" / "a" / "batch.json").write_text('{"steps": {"entropy": 3')
    assert steps_made(shelf, item) == list(STEPS)


def steps_made(shelf: BatchRunner, item: BatchItem) -> list[str]:
    commands = Made()
    outcome = shelf.work(item, commands)
    assert not outcome.sentence and outcome.steps_run == len(commands.lines)
    return [line[0] for line in commands.lines]


def test_step_key_includes_outside_scene_and_variant(shelf_of, tmp_path):
    folder = shelf_of("a", "b") / "a"
    scene = shutil.copy(scenes.path("vase"), tmp_path / "shelf")  # next to all captures
    record = json.loads((folder / "capture.json").read_text()) | {"scene": "../vase.xml"}
    (folder / "capture.json").write_text(json.dumps(record))
    shelf = BatchRunner(output=tmp_path / "shelf" / "out")
    item = BatchItem("a", folder)
    assert steps_made(shelf, item) == list(STEPS) and steps_made(shelf, item) == []
    os.utime(scene)
    assert steps_made(shelf, item) == list(STEPS)
    (tmp_path / "shelf" / "texture.png").touch()
    assert steps_made(shelf, item) == list(STEPS)
    os.utime(tmp_path / "shelf" / "b" / "capture.json")  # another capture of the same scene
    assert steps_made(shelf, item) == []
    lit = BatchItem("a", folder, {"light": str(tmp_path / "shelf" / "l.exr")})
    (tmp_path / "shelf" / "l.exr").touch()  # next to the scene
    assert steps_made(shelf, lit) == list(STEPS)
    os.utime(scene)
    assert steps_made(shelf, lit) == list(STEPS) and steps_made(shelf, item) == list(STEPS)
    other = BatchRunner(output=shelf.output, variant="cuda_ad_rgb", words=("-t", "2"))
    assert steps_made(other, item) == list(STEPS) and steps_made(other, item) == []


def test_a_scene_beside_the_results_is_done_once(tmp_path, monkeypatch):
    scene = shutil.copy(scenes.path("vase"), tmp_path)
    monkeypatch.chdir(tmp_path)
    for out, path in (("out/one", Path("vase.xml")), ("out/two", Path(scene))):
        shelf, item = BatchRunner(output=Path(out)), BatchItem("vase", path)
        assert steps_made(shelf, item) == list(STEPS) and steps_made(shelf, item) == []
    os.utime(scene)
    assert steps_made(shelf, item) == list(STEPS)


def test_commands_get_the_options_they_know(tmp_path):
    options = {"resolution": "16 8", "preset": "fast", "light": "l.exr"}
    item = BatchItem("a", tmp_path, options)
    words = {name: command_words(step, item, tmp_path, STEPS) for name, step in STEPS.items()}
    expected = ["--resolution", "16", "8", "--preset=fast", "--light=l.exr"]
    assert words["entropy"][4:] == expected
    assert "--preset" not in words["recover"]
    assert words["report"][-2:] == ["--recovered", str(tmp_path / "recovered")]
    assert words["export"][1] == str(tmp_path / "recovered")
    assert step_key(words["entropy"], "") != step_key(words["entropy"], "x")


def test_commands_accept_paths_with_spaces_and_dashes(tmp_path):
    given = {"light": "my lamps/a b.exr", "images": "-a b", "shape": "--my shape"}
    options = given | {"resolution": "16", "preset": "fast"}
    for name in ("entropy", "recover", "report"):
        words = command_words(
            STEPS[name], BatchItem("a", tmp_path / "a b", options), tmp_path, ["recover"]
        )
        parsed = as_dict(parse(*words))
        assert str(parsed["light"]) == given["light"] and parsed["shape"] == given["shape"]
        assert str(parsed["images"]) == given["images"] and parsed["scene"] == tmp_path / "a b"


def test_killed_command_is_retried_failed_one_is_not(shelf_of, tmp_path):
    item = BatchItem("a", shelf_of("a") / "a")
    shelf = BatchRunner(output=tmp_path / "out", steps=["entropy"])
    commands = Made([-9, -9])
    assert shelf.work(item, commands).steps_run == 1 and len(commands.lines) == 3
    shelf = BatchRunner(output=tmp_path / "other", steps=["entropy"])
    assert shelf.work(item, Made([-9] * 3)).sentence == "entropy: was killed 3 times (signal 9)"
    outcome = shelf.work(item, Made([2]))
    assert outcome.sentence == "entropy: went wrong" and not read_done(outcome.folder)


def test_a_command_that_left_a_checkpoint_goes_on_from_it(shelf_of, tmp_path):
    item = BatchItem("a", shelf_of("a") / "a")
    shelf = BatchRunner(output=tmp_path / "out", steps=["recover"], words=("-t", "2"))
    left = shelf.output / "a" / STEPS["recover"].checkpoint

    class Killed(Made):
        def run(self, words):
            left.parent.mkdir(parents=True, exist_ok=True)
            left.touch()
            return super().run(words)

    killed = Killed([-9] * 3)
    assert shelf.work(item, killed).sentence
    assert ["--resume" in line for line in killed.lines] == [False, True, True]
    again = Made()
    assert shelf.work(item, again).steps_run == 1 and again.lines[0][-1] == "--resume"


def test_a_checkpoint_that_cannot_be_gone_on_from_is_removed(shelf_of, tmp_path):
    item = BatchItem("a", shelf_of("a") / "a")
    shelf = BatchRunner(output=tmp_path / "out", steps=["recover"])
    left = shelf.output / "a" / STEPS["recover"].checkpoint

    def tried(*statuses):
        commands = Made(statuses)
        outcome = shelf.work(item, commands)
        return outcome.sentence, ["--resume" in line for line in commands.lines], left.exists()

    assert tried(2)[0]
    left.parent.mkdir(parents=True)
    left.write_bytes(b"half a checkpo")
    assert tried(130) == (
        "recover: went wrong",
        [True],
        True,
    )  # after Ctrl-C the checkpoint is valid
    assert tried(2, 2) == ("recover: went wrong", [True, False], False)
    left.touch()
    assert tried(2) == ("", [True, False], False)


def test_what_cannot_be_read_or_written_is_a_row(shelf_of, tmp_path, monkeypatch):
    folder = shelf_of("file", "full", "good", "odd")
    (folder / "odd" / "capture.json").write_text("{")
    out = tmp_path / "out"
    out.mkdir()
    (out / "file").write_text("a file")

    def written(folder, done):
        if folder.name == "full" and "report" in done:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "out/full/batch.json")
        write_done(folder, done)

    monkeypatch.setattr("svu_mi.cli.batch.runner.write_done", written)
    monkeypatch.setattr("svu_mi.cli.batch.runner.CommandPool", lambda _: Made())
    outcomes = {one.name: one for one in BatchRunner(output=out).run(read_list(folder))}
    assert "is a file, not a folder" in outcomes["file"].sentence
    assert outcomes["full"].sentence.startswith("out/full/batch.json: No space left on device; ")
    assert outcomes["full"].done == ("entropy", "recover") and outcomes["full"].steps_run == 2
    assert "capture.json: not a readable JSON" in outcomes["odd"].sentence
    assert not outcomes["good"].sentence and outcomes["good"].steps_run == len(STEPS)


@pytest.mark.parametrize("number", ["1e999", "1" + "0" * 400, "NaN", "-1", '"3"', "[]", "true"])
def test_damaged_records_are_made_again(shelf_of, tmp_path, number):
    runner, item = BatchRunner(output=tmp_path / "out"), BatchItem("a", shelf_of("a") / "a")
    assert runner.work(item, Made()).steps_run == len(STEPS)
    record = tmp_path / "out" / "a" / "batch.json"
    text = re.sub(r'"seconds": [\d.e-]+', f'"seconds": {number}', record.read_text())
    record.write_text(text)
    run_record = tmp_path / "out" / "a" / "entropy" / "run.json"
    figures = '"intervals": {"seen_part": X, "all_known_part": 0.5}, "mean_entropy_of_seen": 0.5'
    run_record.write_text(f'{{"result": {{{figures.replace("X", number)}}}}}')
    outcome = runner.work(item, Made())
    assert outcome.sentence == "" and math.isfinite(outcome.seconds)
    assert outcome.figures == {}
    withheld = figures.replace("X", "0.7").replace('part": 0.5', 'part": null')  # estimated light
    run_record.write_text(f'{{"result": {{{withheld}}}}}')
    assert runner.work(item, Made()).figures == {"seen": 0.7, "entropy": 0.5}


@pytest.mark.slow
def test_captures_with_names_of_options_are_captures(shelf_of, tmp_path, monkeypatch):
    os.rename(shelf_of("a") / "a", tmp_path / "--help")
    monkeypatch.chdir(tmp_path)
    items = read_list(table(Path(), "capture,name", "--help,a"))
    runner = BatchRunner(output=Path("-o"), steps=["entropy"], options={"resolution": "8"})
    outcome = runner.work(items[0], CommandPool())
    assert outcome.sentence == "" and (Path("-o") / "a" / "entropy" / "entropy.exr").is_file()


def test_a_step_without_its_result_is_not_done(shelf_of, tmp_path, monkeypatch):
    item, commands = BatchItem("a", shelf_of("a") / "a"), Made()
    runner = BatchRunner(output=tmp_path / "out", steps=["entropy"])
    monkeypatch.setattr(commands, "run", lambda _: ProcessResult(0, "", 1))
    outcome = runner.work(item, commands)
    assert outcome.sentence == "entropy: ended with status 0, without a result"
    assert not outcome.done and not read_done(outcome.folder)


def test_a_file_that_vanishes_while_it_is_looked_at_is_a_row(shelf_of, tmp_path, monkeypatch):
    def vanished(*_):
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", "view_0001.exr")

    monkeypatch.setattr("svu_mi.cli.batch.steps.stamps", vanished)
    outcome = BatchRunner(output=tmp_path / "out").work(BatchItem("a", shelf_of("a") / "a"), Made())
    assert outcome.sentence.startswith("view_0001.exr: No such file or directory; ")


@pytest.mark.parametrize("name", ["index.html", "Index.CSV"])
def test_reserved_capture_names_are_refused(shelf_of, tmp_path, name):
    folder = shelf_of("a", name)
    for path in (folder, table(tmp_path, "capture,name", f"shelf/a,{name}")):
        with pytest.raises(OptionError, match=f"the capture name '{name}'"):
            read_list(path)


@pytest.mark.parametrize(("said", "sentence"), [
    ("svu: warning: dark\nsvu: a/view_0001.exr: not an EXR.", "a/view_0001.exr: not an EXR."),
    ("Aborted (core dumped)\n ─────\n\n", "Aborted (core dumped)"),
    ("", ""),
    ("╭─ Odd ─╮\n│ box   │\n╰───────╯\nsvu: the end.", "the end."),
])  # fmt: skip
def test_the_sentence_of_a_row_is_the_last_that_was_said(said, sentence):
    assert last_sentence(said) == sentence


def test_a_command_ends_with_its_killed_batch():
    """Whether it has begun, when the kernel kills it, or not, when it ends by itself."""
    reader, writer = os.pipe()
    if (batch := os.fork()) == 0:
        if os.fork() == 0:
            signal.alarm(60)
            end_with_parent(os.getppid())
            os.write(writer, b"x")
        signal.pause()
    os.close(writer)
    assert os.read(reader, 1) == b"x"
    os.kill(batch, signal.SIGKILL)
    os.waitpid(batch, 0)
    assert select.select([reader], [], [], 30)[0] and os.read(reader, 1) == b""  # nobody writes
    os.close(reader)
    with pytest.raises(SystemExit):
        end_with_parent(batch)


def test_nothing_is_loaded_from_where_a_batch_runs(tmp_path, monkeypatch):
    for name in ("svu_mi", "numpy", "mitsuba"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'loaded')!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    ended = CommandPool().run(["entropy", "nowhere", "-o", "out"])
    assert ended.status == 2 and "nowhere" in ended.message
    assert not (tmp_path / "loaded").exists()


def test_thumbnail_is_redrawn_only_if_changed(tmp_path, monkeypatch):
    from PIL import Image

    (tmp_path / "a" / "entropy").mkdir(parents=True)
    path, asked = tmp_path / "a" / "entropy" / "overview.png", []
    monkeypatch.setattr(batch_page, "embedded_png", lambda *_: asked.append(1))
    for color in ("red", "red", "blue"):
        if not path.is_file() or color == "blue":
            Image.new("RGB", (32, 16), color).save(path)
            os.utime(path, (len(asked) + 1, len(asked) + 1))
        batch_page.thumbnail(tmp_path / "a")
    assert len(asked) == 2


def test_page_links_current_results(shelf_of, tmp_path):
    item, out = BatchItem("a", shelf_of("a") / "a"), tmp_path / "out"

    def linked(shelf, *statuses):
        write_index(out, [shelf.work(item, Made(statuses))])
        page = (out / "index.html").read_text()
        return [name for name, step in STEPS.items() if f'href="a/{step.output}' in page]

    assert linked(BatchRunner(output=out)) == list(STEPS)
    assert linked(BatchRunner(output=out, steps=["report"])) == ["report"]
    os.utime(item.capture / "view_0002.exr")
    assert linked(BatchRunner(output=out), 0, 2) == ["entropy"]
    (out / "a" / "report.html").unlink()
    assert (out / "a" / "asset" / "asset.json").is_file()
    assert linked(BatchRunner(output=out)) == list(STEPS)


def test_table_of_results_has_a_row_per_capture(tmp_path):
    figures = {"seen": 0.98765, "entropy": 0.5, "known": 0.25}
    good = Outcome("b", tmp_path / "b", seconds=12.34, peak=1_234_000_000, figures=figures)
    write_index(tmp_path, [good, Outcome("a", tmp_path / "a", "entropy: no light, no luck")])
    assert (tmp_path / "index.csv").read_text().splitlines() == [
        "capture,seen,entropy,known,seconds,peak_gb,problem",
        'a,,,,0.0,0.00,"entropy: no light, no luck"',
        "b,0.9877,0.5000,0.2500,12.3,1.23,",
    ]


def test_a_batch_makes_its_folder_goes_on_and_counts(shelf_of, tmp_path, capsys, monkeypatch):
    shelf, out, statuses = shelf_of("a", "b"), tmp_path / "deep" / "out", []
    monkeypatch.setattr("svu_mi.cli.batch.runner.CommandPool", lambda _: Made(statuses))
    for status, said in (
        (0, "2 of 2 captures done, 8 steps made."), (0, "2 of 2 captures done, 0 steps made."),
        (2, "1 of 2 captures done, 0 steps made; failed: b."),
    ):  # fmt: skip
        if status:
            statuses.append(status)
            os.utime(shelf / "b" / "view_0002.exr")
        assert run("batch", shelf, "-o", out) == bool(status)
        lines = capsys.readouterr().out.splitlines()
        assert lines[-2:] == [f"Wrote {out / 'index.html'}", said]
        assert [line[:3] for line in lines if line[:3] in ("a: ", "b: ")] == ["b: "] * bool(status)


@pytest.mark.parametrize("given", [(), ("--trust",)])
def test_commands_are_trusted_if_the_batch_is(shelf_of, tmp_path, monkeypatch, given):
    commands = Made()
    monkeypatch.setattr("svu_mi.cli.batch.runner.CommandPool", lambda _: commands)
    assert run("batch", shelf_of("a"), *given, "-o", tmp_path / "out") == 0
    assert {"--trust" in line for line in commands.lines} == {bool(given)}


def test_second_worker_waits_and_reuses_results(shelf_of, tmp_path):
    """A second run, for example after a killed one, waits for the lock."""
    item, shelf = (
        BatchItem("a", shelf_of("a") / "a"),
        BatchRunner(output=tmp_path / "out", patience=60),
    )

    class Slow(Made):
        def run(self, words):
            time.sleep(0.1)
            return super().run(words)

    def outcomes(shelf):
        with ThreadPoolExecutor(2) as threads:
            return list(threads.map(lambda _: shelf.work(item, Slow()), range(2)))

    assert sorted(one.steps_run for one in outcomes(shelf)) == [0, 4]
    said = sorted(one.sentence for one in outcomes(BatchRunner(output=tmp_path / "other")))
    assert not said[0] and "is writing there; wait for it" in said[1]


def test_a_worker_of_a_cluster_works_on_one_capture_at_a_time(tmp_path, monkeypatch):
    """A worker has one task per thread, but each command uses all threads."""
    distributed = pytest.importorskip("distributed")
    state, memory = SimpleNamespace(nthreads=4), SimpleNamespace(memory_limit=10**9)
    worker = SimpleNamespace(state=state, memory_manager=memory)
    monkeypatch.setattr(distributed, "get_worker", lambda: worker)
    at_work, most = [], []

    def work(self, item, processes):
        at_work.append(item.name)
        most.append(len(at_work))
        time.sleep(0.05)
        at_work.remove(item.name)

    monkeypatch.setattr(BatchRunner, "work", work)
    shelf = BatchRunner(output=tmp_path)
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(lambda name: work_on_cluster(shelf, BatchItem(name, tmp_path)), "abcd"))
    assert most == [1, 1, 1, 1]


# --- whole runs -------------------------------------------------------------------------------


def test_an_index_without_any_result_is_written(tmp_path):
    write_index(tmp_path, [], waiting=3)
    assert "0 of 3 captures are finished, 3 waiting" in (tmp_path / "index.html").read_text()


def maps(out: Path) -> dict[str, bytes]:
    pixels = {}
    for path in sorted(out.glob("*/entropy/*.exr")) + sorted(out.glob("*/recovered/*.exr")):
        planes = read_exr(path)
        pixels[str(path.relative_to(out))] = b"".join(planes[name].tobytes() for name in planes)
    return pixels


@pytest.mark.slow
def test_killed_workers_give_the_same_maps(shelf_of, tmp_path):
    folder = shelf_of("a", "b")
    words = ["batch", folder, *SMALL, "--steps", "entropy", "recover"]
    assert run(*words, "-o", tmp_path / "one") == 0
    expected = maps(tmp_path / "one")
    assert len(expected) >= 6

    out = tmp_path / "killed"
    line = [sys.executable, "-m", "svu_mi", *map(str, words), "--workers", "2", "-o", str(out)]
    for number, pause in enumerate((1.7, 4.3)):
        process = subprocess.Popen(line, stderr=subprocess.PIPE)
        time.sleep(pause)
        process.send_signal(signal.SIGKILL if number % 2 else signal.SIGINT)
        process.communicate()
    process = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
    over = threading.Event()

    def kill_workers():
        for pause in (1.9,):
            if not over.wait(pause):
                processes = subprocess.run(
                    ["pgrep", "-P", str(process.pid)], capture_output=True, text=True
                ).stdout.split()
                for one in processes[:1]:
                    os.kill(int(one), signal.SIGKILL)

    killing = threading.Thread(target=kill_workers)
    killing.start()
    said = process.communicate()[0]
    over.set()
    killing.join()
    assert process.returncode == 0, said
    assert maps(out) == expected

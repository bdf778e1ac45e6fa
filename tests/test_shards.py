"""Shards: sums that are made apart and added say what all photographs together say."""

from __future__ import annotations

import faulthandler
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from concurrent.futures import CancelledError
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import MagicMock

import mitsuba as mi
import numpy as np
import pytest
from helpers import fails, run, write_dark
from PIL import Image

import svu_mi as svu
from svu_mi import estimators, scenes
from svu_mi.errors import SvuError
from svu_mi.exr import read_exr
from svu_mi.npz import read_arrays
from svu_mi.posterior.tiled import TiledPosterior
from svu_mi.shards.work import LOG, forget
from svu_mi.statistics.gather import Weighting

SIDE = 32
MAPS = ("entropy", "coverage", "roughness_mean", "metallic_sd", "base_color_high")
CLOSE = 1e-6


@pytest.fixture(autouse=True)
def _nothing_is_kept():
    """Every test loads its own photographs."""
    yield
    forget()


@pytest.fixture(scope="module")
def clipped(shot, tmp_path_factory):
    """The capture in 8 bits, some of it clipped: rounding, and passes over clipped samples."""
    folder = shutil.copytree(shot, tmp_path_factory.mktemp("clipped") / "shot")
    gain = 0.8 / np.quantile(np.array(mi.Bitmap(str(next(folder.glob("view*.exr")))))[..., :3], 0.9)
    for path in sorted(folder.glob("view_*.exr")):
        pixels = np.array(mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGBA))
        color, alpha = np.clip(pixels[..., :3] * gain, 0, 1), pixels[..., 3:]
        encoded = np.where(color > 0.0031308, 1.055 * color ** (1 / 2.4) - 0.055, 12.92 * color)
        both = np.concatenate([encoded, alpha], axis=-1)
        Image.fromarray(np.round(255 * both).astype(np.uint8)).save(path.with_suffix(".png"))
        path.unlink()
    record = json.loads((folder / "capture.json").read_text())
    kept = {key: value for key, value in record.items() if key not in ("written", "run", "beside")}
    kept |= {"scene": str(scenes.path("vase")), "exposure": [float(gain)] * 8}
    (folder / "capture.json").write_text(json.dumps(kept))
    return folder


def maps_of(estimate) -> dict[str, np.ndarray]:
    return {name: estimate.image(name) for name in MAPS}


def require_close(found, wanted) -> None:
    for name in MAPS:
        np.testing.assert_allclose(found[name], wanted[name], rtol=0, atol=CLOSE, err_msg=name)


def log_of(sums) -> list[list[str]]:
    """Words of what workers have logged: time, machine, process, sum, what happened."""
    return [line.split() for line in (sums.job.folder / LOG).read_text().splitlines()]


# --- sums -------------------------------------------------------------------------------------


@pytest.mark.few(1)
@pytest.mark.filterwarnings("ignore::svu_mi.errors.SvuWarning")
@pytest.mark.parametrize("name", ["shot", "clipped"])
def test_shards_say_what_all_photographs_together_say(request, name, tmp_path):
    folder = request.getfixturevalue(name)
    capture = svu.load_capture(folder)
    texels = svu.texels(capture.mesh, SIDE)
    whole = svu.estimate(capture, texels)
    found = {}
    for shards in (1, 3):
        sums = svu.gather_shards(None, folder, SIDE, shards=shards, folder=tmp_path)
        found[shards] = maps_of(svu.estimate(sums))
        assert sums.capture.used == capture.used
        assert sums.tally.made == shards * (5 if name == "clipped" else 2 + (name == "shot"))
    require_close(found[3], maps_of(whole))
    require_close(found[1], maps_of(whole))
    seen = svu.estimate(capture, texels).observed
    assert sums.unit == seen.unit  # to the bit: weights are the same
    np.testing.assert_array_equal(sums.coverage, seen.coverage)
    np.testing.assert_array_equal(sums.all_views.per_view, seen.all_views.per_view)
    clips = (None, None) if name == "shot" else (sums.clipped_coverage, seen.clipped_coverage)
    np.testing.assert_array_equal(*clips)


@pytest.mark.slow
def test_the_same_statistics_come_of_shards(shot, tmp_path):
    capture = svu.load_capture(shot)
    seen = svu.estimate(capture, svu.texels(capture.mesh, SIDE)).observed
    sums = svu.gather_shards(None, shot, SIDE, shards=4, folder=tmp_path)
    levels, weighting = np.linspace(0, 1, 3), Weighting(seen.unit)
    switches = svu.preset("default", method="angular")
    ours, theirs = (
        one.statistics(levels, switches, 3, weighting=weighting) for one in (sums, seen)
    )
    np.testing.assert_allclose(ours.table(), theirs.table(), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ours.weight, theirs.weight, rtol=1e-12)
    np.testing.assert_array_equal(ours.views.numpy(), theirs.views.numpy())
    some = seen.seen[5:25]
    ours, theirs = (
        one.statistics(levels, switches, 3, weighting=weighting, texels=some)
        for one in (sums, seen)
    )
    np.testing.assert_allclose(ours.table(), theirs.table(), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(ours.texel.numpy(), some)


@pytest.mark.slow
def test_many_texels_are_worked_on_tile_by_tile(shot, tmp_path, monkeypatch):
    whole = maps_of(svu.estimate(svu.gather_shards(None, shot, SIDE, shards=2, folder=tmp_path)))
    monkeypatch.setattr(estimators, "TILE", 100)
    monkeypatch.setattr(estimators, "TiledPosterior", partial(TiledPosterior, size=150))
    sums = svu.gather_shards(None, shot, SIDE, shards=2, folder=tmp_path)
    found = svu.estimate(sums)
    assert isinstance(found.posterior, TiledPosterior) and sums.tally.made > 5 * 2
    require_close(maps_of(found), whole)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::svu_mi.errors.SvuWarning")
def test_a_shard_of_black_photographs_adds_nothing(shot, tmp_path):
    """It has no photograph that can be used, and its views are left out as ever."""
    folder = shutil.copytree(shot, tmp_path / "dark")
    record = json.loads((folder / "capture.json").read_text())
    record["scene"] = str(scenes.path("vase"))
    record.pop("written", None)
    (folder / "capture.json").write_text(json.dumps(record))
    for number in (0, 1):
        path = folder / f"view_{number:04d}.exr"
        pixels = np.array(mi.Bitmap(str(path)))
        pixels[..., :3] = 0
        mi.Bitmap(pixels).write(str(path))
    capture = svu.load_capture(folder)
    assert capture.used == (False, False, *[True] * 6)
    whole = maps_of(svu.estimate(capture, svu.texels(capture.mesh, SIDE)))
    sums = svu.gather_shards(None, folder, SIDE, shards=4, folder=tmp_path / "sums")
    assert sums.capture.used == capture.used and sums.lighting.prefilter == 6**-0.5
    require_close(maps_of(svu.estimate(sums)), whole)


# --- files ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_sums_that_are_there_are_not_made_again(shot, tmp_path):
    first = svu.gather_shards(None, shot, SIDE, shards=3, folder=tmp_path)
    wanted = maps_of(svu.estimate(first))
    forget()
    again = svu.gather_shards(None, shot, SIDE, shards=3, folder=tmp_path)
    found = maps_of(svu.estimate(again))
    assert again.tally.made == 0
    for name in MAPS:
        np.testing.assert_array_equal(found[name], wanted[name])
    files = sorted(first.job.folder.glob("statistics-*.npz"))
    assert len(files) == 3
    files[0].unlink()
    files[2].write_bytes(files[2].read_bytes()[:-100])  # as no run leaves it: it says so itself
    for inputs in first.job.folder.glob("inputs-*.npz"):
        inputs.write_bytes(inputs.read_bytes()[:100])
    last = svu.gather_shards(None, shot, SIDE, shards=3, folder=tmp_path)
    found = maps_of(svu.estimate(last))
    assert last.tally.made == 2
    for name in MAPS:
        np.testing.assert_array_equal(found[name], wanted[name])
    last.clear()
    assert not last.job.folder.exists()


@pytest.mark.slow
def test_other_photographs_options_and_weights_have_sums_of_their_own(shot, tmp_path):
    folder = shutil.copytree(shot, tmp_path / "shot")
    record = json.loads((folder / "capture.json").read_text())
    record["scene"] = str(scenes.path("vase"))
    (folder / "capture.json").write_text(json.dumps(record))
    first = svu.gather_shards(None, folder, SIDE, shards=2, folder=tmp_path / "sums")
    svu.estimate(first)
    made = first.tally.made
    svu.estimate(first, preset="fixed")  # the same views, other sums
    assert first.tally.made > made
    others = [
        svu.gather_shards(None, folder, SIDE, shards=4, folder=tmp_path / "sums"),
        svu.gather_shards(None, folder, SIDE // 2, shards=2, folder=tmp_path / "sums"),
    ]
    os.utime(folder / "view_0003.exr", (1, 1))
    others.append(svu.gather_shards(None, folder, SIDE, shards=2, folder=tmp_path / "sums"))
    folders = {one.job.folder for one in (first, *others)}
    assert len(folders) == 4 and all(one.tally.made for one in others)


# --- refusals ---------------------------------------------------------------------------------


def test_what_needs_photographs_in_one_place_is_a_sentence(shot, tmp_path):
    sums = svu.gather_shards(None, shot, SIDE, shards=2, folder=tmp_path)
    with pytest.raises(svu.SvuError, match="Power spectra need all photographs in one place"):
        svu.estimate(sums, method="spectrum")
    with pytest.raises(svu.SvuError, match="fits the light that all photographs together mirror"):
        svu.estimate(sums, preset="paper")
    found = svu.estimate(sums)
    with pytest.raises(svu.SvuError, match="photographs are in shards, of which only estimates"):
        svu.recover(sums)
    with pytest.raises(svu.SvuError, match="The estimate does not know its capture"):
        svu.recover(found)


def test_what_cannot_be_shared_out_is_a_sentence(shot, vase, tmp_path):
    def made(capture, **options):
        return svu.gather_shards(None, capture, SIDE, folder=tmp_path / "sums", **options)

    with pytest.raises(svu.SvuError, match="made in memory, where workers cannot read it"):
        made(vase.capture)
    with pytest.raises(svu.SvuError, match="at least one shard, got 0"):
        made(shot, shards=0)
    with pytest.raises(svu.SvuError, match="the capture has no light"):
        made(write_dark(shot, tmp_path / "dark"))
    capture = svu.load_capture(shot, views=())
    with pytest.raises(svu.SvuError, match="exposures were changed after they were loaded"):
        made(replace(capture, exposures=(2.0,) * 8))
    with pytest.raises(svu.SvuError, match="there is no view 8; there are 8, from 0 on"):
        svu.load_capture(shot, views=[0, 8])
    texels = svu.texels(capture.mesh, SIDE)
    with pytest.raises(svu.SvuError, match="texels are not of the capture's mesh"):
        svu.gather_shards(
            None, shot, replace(texels, face=texels.face + 1), folder=tmp_path / "sums"
        )


def test_views_that_are_not_read_are_not_used(shot):
    some, whole = svu.load_capture(shot, views=[2, 5]), svu.load_capture(shot)
    assert some.used == tuple(view in (2, 5) for view in range(8))
    assert some.names == whole.names and some.count == 8
    np.testing.assert_array_equal(some.images[5], whole.images[5])
    assert np.isnan(some.images[0]).all() and some.images[0].strides == (0, 0, 0)
    assert not any(svu.load_capture(shot, views=()).used)


# --- the command ------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_writes_the_same_and_cleans_up(shot, tmp_path, capsys):
    words = ("entropy", shot, "--resolution", SIDE, "--no-pictures")
    assert run(*words, "-o", tmp_path / "whole") == 0
    assert run(*words, "--shards", 3, "-o", tmp_path / "sums") == 0
    assert "9 sums of 3 shards were made now" in capsys.readouterr().out
    both = [read_exr(tmp_path / name / "entropy.exr") for name in ("whole", "sums")]
    for name, plane in both[0].items():
        np.testing.assert_allclose(both[1][name], plane, rtol=0, atol=CLOSE)
    assert not (tmp_path / "sums" / "shards").exists()


def test_the_command_deletes_no_files_of_others(shot, tmp_path):
    own = tmp_path / "shards" / "notes" / "mine.txt"
    own.parent.mkdir(parents=True)
    own.write_text("mine")
    words = ("--resolution", SIDE // 2, "--no-pictures", "--shards", 2, "-o", tmp_path)
    assert run("entropy", shot, *words) == 0
    assert [path.name for path in (tmp_path / "shards").iterdir()] == ["notes"] and own.is_file()


@pytest.mark.parametrize(("words", "sentence"), [
    (("--scheduler", "tcp://x:1"), "say how many, such as --shards 8"),
    (("--shards", -1), "--shards must be in 0 ... 10000, got -1"),
    (("--shards", 2, "--method", "spectrum"), "--shards and --method spectrum do not go together"),
    (("--shards", 2, "--gains", "estimate"), "--gains estimate do not go together"),
    (("--shards", 2, "--scheduler", "no address"), "nobody answers there"),
])  # fmt: skip
def test_words_that_do_not_go_together(shot, tmp_path, capsys, monkeypatch, words, sentence):
    from svu_mi.shards import cluster

    monkeypatch.setattr(cluster, "SECONDS", 1)
    said = fails(capsys, "entropy", shot, "-o", tmp_path / "o", "--resolution", SIDE, *words)
    assert sentence in said


# --- clusters ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def client():
    """Two worker processes of one thread."""
    distributed = pytest.importorskip("distributed")

    def start():
        return distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        )

    try:
        started = start()
    except AssertionError:  # its thread has not begun after ten seconds, on a machine that stood
        faulthandler.dump_traceback(sys.__stderr__)
        started = start()
    with started as cluster, distributed.Client(cluster) as client:
        yield client


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::svu_mi.errors.SvuWarning")
@pytest.mark.parametrize("name", ["shot", "clipped"])
def test_two_processes_make_the_same_as_one(request, client, name, tmp_path):
    folder = request.getfixturevalue(name)
    two = svu.gather_shards(client, folder, SIDE, shards=8, folder=tmp_path / "two")
    found = maps_of(svu.estimate(two))
    one = svu.gather_shards(None, folder, SIDE, shards=8, folder=tmp_path / "one")
    wanted = maps_of(svu.estimate(one))
    assert two.tally.made == one.tally.made and len(set(two.tally.homes.values())) == 2
    for name in MAPS:
        np.testing.assert_array_equal(found[name], wanted[name])


def kill_before(begun: list[str], folder: Path) -> bool:
    """Kill a process unless the sum that it has begun is there by now; return whether it was."""
    psutil = pytest.importorskip("psutil")  # Dask comes with it
    process = psutil.Process(int(begun[2]))
    process.suspend()
    while process.status() != psutil.STATUS_STOPPED:
        time.sleep(0.001)
    is_there = (folder / f"{begun[3]}.npz").exists()
    (process.resume if is_there else process.kill)()
    return not is_there


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_the_shard_it_was_at(client, shot, tmp_path):
    """Killed while it makes one of its sums of statistics; nothing else is made twice."""
    wanted = svu.gather_shards(None, shot, 128, shards=8, folder=tmp_path / "one")
    maps = maps_of(svu.estimate(wanted))
    sums = svu.gather_shards(client, shot, 128, shards=8, folder=tmp_path / "two")
    killed, over = [], threading.Event()

    def kill() -> None:
        while not killed and not over.wait(0.002):
            lines = [words for words in log_of(sums) if words[3].startswith("statistics")]
            at_it = {words[2]: words for words in lines}  # the last line of each process
            busy = [words for words in at_it.values() if words[4] == "begins"]
            if len(lines) >= 5 and busy and kill_before(busy[0], sums.job.folder):
                killed.append(busy[0])

    watcher = threading.Thread(target=kill)
    watcher.start()
    try:
        found = maps_of(svu.estimate(sums))
    finally:
        over.set()
        watcher.join()
    assert killed
    for name in MAPS:
        np.testing.assert_array_equal(found[name], maps[name])
    begun = [words[3] for words in log_of(sums) if words[4] == "begins"]
    assert len(set(begun)) == 24 and len(begun) == 25
    assert sums.tally.made >= 23  # one may have been told of by the worker that is dead
    for name in {*begun}:
        read_arrays(sums.job.folder / f"{name}.npz")  # none is half written


@pytest.mark.slow
def test_the_command_works_on_a_cluster(client, shot, tmp_path):
    words = ("entropy", shot, "--resolution", SIDE, "--no-pictures", "--shards", 4)
    assert run(*words, "-o", tmp_path / "here") == 0
    there = ("--scheduler", client.scheduler.address)
    assert run(*words, *there, "-o", tmp_path / "there") == 0
    both = [read_exr(tmp_path / name / "entropy.exr") for name in ("here", "there")]
    for name, plane in both[0].items():
        np.testing.assert_array_equal(both[1][name], plane)


@pytest.mark.parametrize("name", ["CommClosedError", "CancelledError"])
def test_a_connection_that_is_lost_is_a_sentence(monkeypatch, name):
    """Dask says it in two ways: of results on their way, and of work that is not done."""
    distributed = pytest.importorskip("distributed")
    from svu_mi.shards import cluster

    known = {"CommClosedError": distributed.comm.CommClosedError, "CancelledError": CancelledError}
    monkeypatch.setattr(cluster, "_client", MagicMock())
    with pytest.raises(SvuError, match="connection was lost"), cluster.connected("tcp://there:1"):
        raise known[name]("Stream is closed.")


@pytest.mark.slow
def test_a_scheduler_that_ends_is_a_sentence(shot, tmp_path, capsys):
    """It ends with its process, while a worker is at the first sum."""
    distributed = pytest.importorskip("distributed")
    code = "from distributed.cli.dask_scheduler import main; main()"
    line = [sys.executable, "-c", code, "--port", "0", "--no-dashboard", "--scheduler-file"]
    place = tmp_path / "scheduler.json"
    scheduler = subprocess.Popen([*line, str(place)], stderr=subprocess.DEVNULL)
    while not place.exists() or not place.read_text():
        time.sleep(0.1)
    address = json.loads(place.read_text())["address"]
    code = "from distributed.cli.dask_worker import main; main()"
    line = [sys.executable, "-c", code, address, "--nthreads", "1", "--no-dashboard"]
    worker = subprocess.Popen(line, stderr=subprocess.DEVNULL)
    try:
        with distributed.Client(address) as client:
            client.wait_for_workers(1, timeout=60)
        threading.Timer(2.5, scheduler.kill).start()
        words = ("--resolution", 400, "--shards", 8, "--scheduler", address, "-o", tmp_path / "o")
        said = fails(capsys, "entropy", shot, *words)
    finally:
        for process in (worker, scheduler):
            process.terminate()
            process.wait()
    assert "the connection was lost; what is done is kept, and the same command goes on" in said
    assert "Traceback" not in said


@pytest.mark.slow
def test_what_a_worker_cannot_do_is_said_here(client, shot, tmp_path):
    folder = shutil.copytree(shot, tmp_path / "shot")
    record = json.loads((folder / "capture.json").read_text())
    record["scene"] = str(scenes.path("vase"))
    (folder / "capture.json").write_text(json.dumps(record))
    Path(folder / "view_0005.exr").write_bytes(b"no picture")
    with pytest.raises(svu.SvuError, match=r"view_0005\.exr"):
        svu.gather_shards(client, folder, SIDE, shards=4, folder=tmp_path / "sums")


@pytest.mark.slow
def test_captures_are_tasks_of_a_cluster(client, shot, tmp_path):
    """A batch there has the same results as here, and the same command has nothing left to do."""
    for name in ("a", "b", "broken"):
        folder = shutil.copytree(shot, tmp_path / "shelf" / name)
        record = json.loads((folder / "capture.json").read_text())
        record["scene"] = str(scenes.path("vase"))
        (folder / "capture.json").write_text(json.dumps(record))
    (tmp_path / "shelf" / "broken" / "view_0005.exr").write_bytes(b"no picture")
    words = ("batch", tmp_path / "shelf", "--steps", "entropy", "--resolution", SIDE)
    there = (*words, "--scheduler", client.scheduler.address, "-o", tmp_path / "there")
    assert run(*there) == 1
    assert run(*words, "-o", tmp_path / "here") == 1
    for name in ("a", "b"):
        both = [read_exr(tmp_path / where / name / "entropy" / "entropy.exr")
                for where in ("here", "there")]  # fmt: skip
        for channel, plane in both[0].items():
            np.testing.assert_array_equal(both[1][channel], plane)
    table = (tmp_path / "there" / "index.csv").read_text()
    assert "view_0005.exr" in table and table.count("\n") == 4
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "there").rglob("entropy.exr")}
    assert run(*there) == 1
    assert before == {path: path.stat().st_mtime_ns for path in before}

"""Checkpoints: complete or missing, refused for other runs, sufficient to resume."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from svu_mi.errors import OptionError, OutputError
from svu_mi.recovery.adam import descend
from svu_mi.recovery.checkpoint import Checkpoint, DescentState
from svu_mi.recovery.recovery_options import DescentOptions

SHAPES = {"base_color": (4, 6, 3), "roughness": (4, 6, 1)}
SETTINGS = {"seed": 3, "descent": {"learning_rate": 0.01, "bounds": [0.0, 1.0]}, "name": "ball"}

# A deterministic objective for a separate process, which needs all 400 steps.
SCRIPT = """
import sys, time
import svu_mi
import drjit as dr, mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(1)
from svu_mi.core.arrays import to_drjit
from svu_mi.recovery.checkpoint import Checkpoint
from svu_mi.recovery.adam import descend
from svu_mi.recovery.recovery_options import DescentOptions

path, out, pause, resume = sys.argv[1], sys.argv[2], float(sys.argv[3]), sys.argv[4] == "resume"
shape = (16, 16, 3)
truth = mi.TensorXf(to_drjit(mi.Float, np.random.default_rng(5).random(768, np.float32)), shape)
start = {"base_color": dr.full(mi.TensorXf, 0.5, shape=shape)}

def objective(textures, step):
    print(step, flush=True)
    time.sleep(pause)
    noise = dr.opaque(mi.Float, 0.1 * ((step * 37) % 11))
    difference = textures["base_color"] - truth
    return dr.mean(dr.square(difference) * (1 + noise), axis=None)

options = DescentOptions(steps=400, learning_rate=0.02, tolerance=1e-5)
checkpoint = Checkpoint(path, {"seed": 5}, resume=resume, every=0.0)
descent = descend(objective, start, options, checkpoint=checkpoint)
np.savez(out, texture=np.array(descent.values["base_color"]), losses=descent.losses)
"""


def state(step=4):
    rng = np.random.default_rng(step)
    textures = {
        "base_color": rng.random((4, 6, 3), np.float32),
        "roughness": rng.random((4, 6, 1), np.float32),
    }
    flat = {name: texture.ravel() for name, texture in textures.items()}
    return DescentState(step=step, values=textures, first=flat, second=flat,
                 losses=rng.random(step, np.float32))  # fmt: skip


def test_saved_checkpoint_loads_unchanged(tmp_path):
    checkpoint = Checkpoint(tmp_path / "c.npz", SETTINGS)
    assert checkpoint.load(SHAPES) is None
    checkpoint.save(state(4))
    checkpoint.save(state(9))
    loaded, wanted = Checkpoint(tmp_path / "c.npz", SETTINGS).load(SHAPES), state(9)
    assert loaded.step == 9
    assert np.array_equal(loaded.losses, wanted.losses)
    for group in ("values", "first", "second"):
        arrays = getattr(loaded, group)
        assert set(arrays) == {"base_color", "roughness"}
        for name, array in arrays.items():
            assert np.array_equal(array, getattr(wanted, group)[name])
            assert array.shape == getattr(wanted, group)[name].shape
    assert os.listdir(tmp_path) == ["c.npz"]


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({**SETTINGS, "seed": 4}, "seed is 3 in the file, 4 now"),
        ({**SETTINGS, "descent": {**SETTINGS["descent"], "bounds": [0.1, 1.0]}}, "descent.bounds"),
        ({**SETTINGS, "more": 1}, "more is None in the file"),
    ],
)
def test_another_runs_checkpoint_is_refused_by_name(tmp_path, changed, words):
    Checkpoint(tmp_path / "c.npz", SETTINGS).save(state())
    with pytest.raises(OptionError, match=words) as caught:
        Checkpoint(tmp_path / "c.npz", changed).load(SHAPES)
    assert str(tmp_path / "c.npz") in str(caught.value)


def test_settings_survive_json(tmp_path):
    """Tuples are read as lists, which counts as the same run."""
    Checkpoint(tmp_path / "c.npz", {"a": (1, 2)}).save(state())
    assert Checkpoint(tmp_path / "c.npz", {"a": [1, 2]}).load(SHAPES) is not None


@pytest.mark.parametrize("part", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_file_is_refused(tmp_path, part):
    path = tmp_path / "c.npz"
    Checkpoint(path, SETTINGS).save(state())
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data))])
    with pytest.raises(OutputError, match="damaged.*start again"):
        Checkpoint(path, SETTINGS).load(SHAPES)


def test_flipped_bits_are_detected(tmp_path):
    """Bits of the whole file; flips without effect (in fields of the zip format) may pass."""
    path = tmp_path / "c.npz"
    Checkpoint(path, SETTINGS).save(state())
    data, wanted = path.read_bytes(), state()
    for place in np.random.default_rng(0).integers(len(data), size=60):
        broken = bytearray(data)
        broken[place] ^= 1 << (place % 8)
        path.write_bytes(bytes(broken))
        try:
            loaded = Checkpoint(path, SETTINGS).load(SHAPES)
        except (OutputError, OptionError):
            continue
        assert loaded.step == wanted.step
        for name, texture in wanted.values.items():
            assert np.array_equal(loaded.values[name], texture)
            assert np.array_equal(loaded.second[name], wanted.second[name])


def test_settings_that_json_cannot_hold_are_refused(tmp_path):
    for bad in ({"a": object()}, {"a": float("nan")}):
        with pytest.raises(OptionError, match="a setting cannot be written as JSON"):
            Checkpoint(tmp_path / "c.npz", bad)
    with pytest.raises(OptionError, match="every must be at least 0 seconds"):
        Checkpoint(tmp_path / "c.npz", {}, every=-1.0)
    assert Checkpoint(tmp_path / "c.npz", {}, every=0.5).every == 0.5


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(OutputError, match="nowhere"):
        Checkpoint(tmp_path / "nowhere" / "c.npz", SETTINGS).save(state())


def test_other_parameters_are_refused(tmp_path):
    import drjit as dr
    import mitsuba as mi

    def objective(textures, step):
        return dr.mean(textures["metallic"].array)

    Checkpoint(tmp_path / "c.npz", {}).save(state())
    start = {"metallic": dr.full(mi.TensorXf, 0.5, shape=(4, 6, 1))}
    checkpoint = Checkpoint(tmp_path / "c.npz", {}, resume=True)
    with pytest.raises(OutputError, match="damaged .first/base_color is unknown"):
        descend(objective, start, DescentOptions(steps=8), checkpoint=checkpoint)


def start_run(tmp_path, out, pause, resume):
    script = tmp_path / "run.py"
    script.write_text(SCRIPT)
    return subprocess.Popen(
        [sys.executable, str(script), str(tmp_path / "c.npz"), str(tmp_path / out), str(pause),
         "resume" if resume else "fresh"], stdout=subprocess.PIPE, text=True,
        # Without a terminal, SIGINT may be ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # noqa: PLW1509
    )  # fmt: skip


def finish(tmp_path, out, resume=False):
    """Run to the end; return the textures and the first step that was taken."""
    process = start_run(tmp_path, out, 0, resume)
    text, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    with np.load(tmp_path / out) as stored:
        return dict(stored), int(text.split()[0])


def interrupt(tmp_path, after, how):
    """Start a run and send it a signal ``after`` seconds after its first checkpoint."""
    process = start_run(tmp_path, "never.npz", 0.005, False)
    while not (tmp_path / "c.npz").exists():
        time.sleep(0.005)
        assert process.poll() is None
    time.sleep(after)
    process.send_signal(how)
    process.communicate(timeout=60)
    assert process.returncode != 0
    assert not (tmp_path / "never.npz").exists()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the result of an uninterrupted run."""
    textures, first = finish(tmp_path_factory.mktemp("whole"), "whole.npz")
    assert first == 0
    return textures


def test_killed_and_resumed_run_has_the_same_textures(tmp_path, whole):
    """Bitwise: one thread, and no sums of random order."""
    interrupt(tmp_path, float(np.random.default_rng(1).uniform(0, 0.7)), signal.SIGKILL)
    resumed, first = finish(tmp_path, "resumed.npz", resume=True)
    assert first > 0
    assert np.array_equal(resumed["texture"], whole["texture"])
    assert np.array_equal(resumed["losses"], whole["losses"])


@pytest.mark.slow
def test_ctrl_c_leaves_a_checkpoint_of_the_last_step(tmp_path, whole):
    interrupt(tmp_path, 0.1, signal.SIGINT)
    stopped = Checkpoint(tmp_path / "c.npz", {"seed": 5}).load({"base_color": (16, 16, 3)})
    assert stopped.step == len(stopped.losses) > 0
    resumed, first = finish(tmp_path, "resumed.npz", resume=True)
    assert first == stopped.step
    assert np.array_equal(resumed["texture"], whole["texture"])
    again, first = finish(tmp_path, "again.npz")  # without resume a run starts anew
    assert first == 0
    assert np.array_equal(again["texture"], whole["texture"])

"""Descent: minimum, bounds, kernels and memory."""

from __future__ import annotations

import gc
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import as_tensor

from svu_mi.errors import OptionError, SvuError
from svu_mi.recovery.adam import READ_EVERY, descend
from svu_mi.recovery.checkpoint import Checkpoint
from svu_mi.recovery.recovery_options import DescentOptions

SHAPE = (8, 12, 3)


def half(shape=SHAPE):
    return {"base_color": dr.full(mi.TensorXf, 0.5, shape=shape)}


def truth(seed=0, shape=SHAPE):
    return np.random.default_rng(seed).random(shape, np.float32)


def towards(wanted):
    """A quadratic loss around given values."""
    target = as_tensor(wanted)

    def objective(textures, step):
        return dr.mean(dr.square(textures["base_color"] - target), axis=None)

    return objective


def adam(wanted, options):
    """Adam with projection in NumPy and float64 [Kingma and Ba 2015]."""
    value = np.full(wanted.shape, 0.5)
    m, v = np.zeros_like(value), np.zeros_like(value)
    losses = []
    for t in range(1, options.steps + 1):
        losses.append(np.mean((value - wanted) ** 2))
        g = 2 * (value - wanted) / value.size
        m = options.beta_1 * m + (1 - options.beta_1) * g
        v = options.beta_2 * v + (1 - options.beta_2) * g * g
        unbiased = m / (1 - options.beta_1**t), (v + 1e-16) / (1 - options.beta_2**t)
        part = (t - 1) / (options.steps - 1)
        step = options.learning_rate * options.final_rate**part * unbiased[0]
        value = np.clip(value - step / np.sqrt(unbiased[1]), options.low, options.high)
    return value, np.array(losses)


def test_it_is_adam_with_a_falling_rate_and_projection():
    options = DescentOptions(steps=60, learning_rate=0.03, final_rate=0.2, low=0.1, high=0.8)
    wanted = truth()
    descent = descend(towards(wanted), half(), options)
    value, losses = adam(wanted.astype(np.float64), options)
    # float32 moments, and gradients that vanish near the minimum: only their direction remains
    assert np.abs(np.array(descent.values["base_color"]) - value).max() < 1e-4
    assert np.allclose(descent.losses, losses, rtol=1e-3)
    assert descent.steps == 60
    assert descent.stopped == "finished"
    assert descent.losses.dtype == np.float32


def test_descent_does_not_modify_its_start():
    start = half()
    descend(towards(truth()), start, DescentOptions(steps=3))
    assert np.all(np.array(start["base_color"]) == 0.5)
    assert not dr.grad_enabled(start["base_color"])


def test_values_stay_within_bounds_from_the_start():
    seen = []

    def objective(textures, step):
        seen.append(np.array(dr.detach(textures["base_color"])))
        return dr.sum(textures["base_color"].array)  # downhill for ever

    start = {"base_color": as_tensor(np.linspace(-1, 2, 12).reshape(2, 2, 3))}
    descent = descend(objective, start, DescentOptions(steps=25, learning_rate=0.2))
    values = np.array([*seen, np.array(descent.values["base_color"])])
    assert values.min() >= 0
    assert values.max() <= 1
    assert np.all(values[-1] == 0)


def test_it_stops_when_the_loss_falls_no_further():
    options = DescentOptions(steps=2000, learning_rate=0.05, final_rate=1.0, tolerance=0.01,
                             window=20)  # fmt: skip

    def objective(textures, step):
        return 1 + towards(truth())(textures, step)

    descent = descend(objective, half(), options)
    assert descent.stopped == "converged"
    assert 40 <= descent.steps < 200
    assert descent.steps % 20 == 0
    assert len(descent.losses) == descent.steps
    mean = descent.losses.reshape(-1, 20).mean(axis=1)
    fallen = 1 - mean[1:] / mean[:-1]
    assert fallen[-1] < 0.01
    assert np.all(fallen[:-1] >= 0.01)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nan_loss_names_its_step_and_keeps_the_checkpoint(tmp_path, bad):
    path = tmp_path / "c.npz"

    def objective(textures, step):
        factor = dr.opaque(mi.Float, bad if step == 17 else 1.0)
        return factor * towards(truth())(textures, step)

    with pytest.raises(SvuError, match="loss of step 17 is NaN or infinite"):
        descend(objective, half(), DescentOptions(steps=40),
                checkpoint=Checkpoint(path, {}, every=0.0))  # fmt: skip
    kept = Checkpoint(path, {}).load({"base_color": SHAPE})
    assert kept.step == READ_EVERY
    assert np.isfinite(kept.values["base_color"]).all()
    assert np.isfinite(kept.losses).all()


def test_nan_gradient_of_a_finite_loss_is_named():
    """The square root of 0 has a finite value and an infinite slope."""

    def objective(textures, step):
        zero = dr.opaque(mi.Float, 0.0 if step == 12 else 1.0)
        return dr.mean(dr.sqrt(textures["base_color"].array * zero))

    with pytest.raises(SvuError, match="a gradient of step 12 is NaN or infinite"):
        descend(objective, half(), DescentOptions(steps=40))


def test_rates_can_be_scaled_by_parameter():
    start = {name: as_tensor(np.full(SHAPE, 0.5)) for name in ("base_color", "roughness")}

    def objective(textures, step):
        return dr.sum(textures["base_color"].array) + dr.sum(textures["roughness"].array)

    options = DescentOptions(steps=4, learning_rate=0.02, final_rate=1.0, scales={"roughness": 0.5})
    moved = {n: 0.5 - np.array(v) for n, v in descend(objective, start, options).values.items()}
    # For constant gradients, steps of Adam equal the rate.
    assert np.allclose(moved["base_color"], 0.08, atol=1e-5)
    assert np.allclose(moved["roughness"], 0.04, atol=1e-5)


@pytest.mark.parametrize(
    "wrong",
    [{"steps": 0}, {"steps": 1.5}, {"learning_rate": 0.0}, {"learning_rate": np.nan},
     {"final_rate": 0.0}, {"final_rate": 2.0}, {"tolerance": -1.0}, {"window": 0},
     {"low": 1.0, "high": 0.0}, {"scales": {"roughness": -1}}, {"beta_1": 1.0},
     {"beta_2": -0.1}],
)  # fmt: skip
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(OptionError, match=next(iter(wrong))):
        DescentOptions(**wrong)


class Watcher:
    def __init__(self):
        self.done, self.texts = [], []

    def update(self, done, total):
        self.done.append((done, total))

    def state(self, text):
        self.texts.append(text)


def test_progress_shows_loss_rate_and_remaining_time():
    watcher = Watcher()
    descend(towards(truth()), half(), DescentOptions(steps=25), progress=watcher)
    assert watcher.done == [(10, 25), (20, 25), (25, 25)]
    assert watcher.texts[0].startswith("loss 0.")
    assert "rate 0.0" in watcher.texts[0]
    assert watcher.texts[1].endswith("s left")


def test_interrupt_saves_the_last_complete_step(tmp_path):
    path = tmp_path / "c.npz"

    def stopping(textures, step):
        if step == 13:
            raise KeyboardInterrupt
        return towards(truth())(textures, step)

    with pytest.raises(KeyboardInterrupt):
        descend(stopping, half(), DescentOptions(steps=30), checkpoint=Checkpoint(path, {}))
    assert Checkpoint(path, {}).load({"base_color": SHAPE}).step == 13
    resumed = descend(towards(truth()), half(), DescentOptions(steps=30),
                      checkpoint=Checkpoint(path, {}, resume=True))  # fmt: skip
    whole = descend(towards(truth()), half(), DescentOptions(steps=30))
    assert np.array_equal(resumed.losses, whole.losses)
    assert np.array_equal(
        np.array(resumed.values["base_color"]), np.array(whole.values["base_color"])
    )


def resident():
    """Resident memory of this process, in bytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096


def test_no_kernel_after_the_second_step_and_flat_memory():
    compiled, memory = {}, {}
    wanted = as_tensor(truth(1, (64, 64, 3)))

    def objective(textures, step):
        if step in (2, 50, 300):
            gc.collect()
            dr.sync_thread()
            compiled[step] = dr.detail.launch_stats()[1:]
            memory[step] = resident()
        scale = dr.opaque(mi.Float, 1 + step)
        return dr.mean(dr.square(textures["base_color"] - wanted), axis=None) / scale

    descend(objective, half((64, 64, 3)), DescentOptions(steps=301))
    assert compiled[2] == compiled[300]  # neither compiled nor loaded from disk
    assert memory[300] - memory[50] < 2 << 20  # 2 MiB: one of 250 steps' textures is 48 KiB

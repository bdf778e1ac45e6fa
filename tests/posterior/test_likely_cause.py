"""Causes that are named from residuals of a made-up object."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from support.helpers import unit_vectors

from svu_mi.core.arrays import fibonacci
from svu_mi.posterior.held_out_samples import HeldOutSamples
from svu_mi.posterior.judge_prediction import judged
from svu_mi.posterior.likely_cause import clear_cause
from svu_mi.posterior.residuals import Surroundings

VIEWS, TEXELS, FOLDS = 30, 240, 6
SUN = np.array([0.6, 0.5, 0.62])


def lit(normal, mirrored, albedo, sun):
    """Return the radiance of a glossy ball under a soft and a hard light, (S, 3)."""
    soft = 0.4 + 0.3 * normal[:, 1] + np.maximum((normal * sun).sum(axis=1), 0)
    shine = np.exp(8 * ((mirrored * sun).sum(axis=1) - 1))
    return albedo * soft[:, None] + 0.8 * shine[:, None]


class Ball:
    """Samples of a ball from all sides; the prediction is the truth with noise of 3 %."""

    def __init__(self, above=False):
        self.random = np.random.default_rng(40913)
        self.normal = fibonacci(TEXELS)
        self.eyes = 4 * unit_vectors(self.random, VIEWS)
        if above:
            self.eyes[:, 1] = np.abs(self.eyes[:, 1])
        self.albedo = self.random.random((TEXELS, 3)) ** 2
        toward = self.eyes[:, None] - self.normal
        toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
        self.view, self.texel = np.nonzero((toward * self.normal).sum(axis=-1) > 0.2)
        self.n, d = self.normal[self.texel], toward[self.view, self.texel]
        self.mirrored = 2 * (self.n * d).sum(axis=1, keepdims=True) * self.n - d
        self.truth = self.seen()

    def seen(self, albedo=None, sun=SUN):
        albedo = self.albedo if albedo is None else albedo
        return lit(self.n, self.mirrored, albedo[self.texel], sun)

    def noisy(self, values):
        return values * (1 + 0.03 * self.random.normal(size=values.shape))

    def judged(self, shown, predicted=None, pixels=None):
        predicted = self.noisy(self.truth) if predicted is None else predicted
        samples = HeldOutSamples(
            self.view, self.texel, self.view % FOLDS, np.ones(len(shown)), shown, predicted,
            np.full(shown.shape, 0.05), np.ones_like(shown),
        )  # fmt: skip
        around = Surroundings(
            np.eye(3), self.normal, self.normal, self.eyes,
            pixels or (lambda *_: lambda _: shown), bool(self.eyes[:, 1].min() > -1),
        )  # fmt: skip
        return judged(samples, around)


@pytest.fixture(scope="module")
def ball():
    return Ball()


def test_a_sound_capture_is_reliable(ball):
    found = ball.judged(ball.noisy(ball.truth))
    assert found.reliable and found.cause == "" and found.r2 > 0.95 > found.r2_of_means
    assert len(found.photographs) == VIEWS and found.sides["+y"].r2 > 0.9
    exact = ball.judged(ball.truth, ball.truth)
    assert (exact.r2, exact.coverage) == (1, 1)


def test_gains_are_named(ball):
    gains = 1.6 ** ball.random.uniform(-1, 1, VIEWS)
    assert ball.judged(ball.truth * gains[ball.view, None]).cause == "gains"


def test_a_light_that_turns_is_named(ball):
    angle = np.arctan2(ball.eyes[:, 0], ball.eyes[:, 2])[ball.view]
    cos, sin, (x, y, z) = np.cos(angle), np.sin(angle), SUN
    suns = np.stack([cos * x + sin * z, np.full_like(cos, y), cos * z - sin * x], axis=1)
    assert ball.judged(ball.seen(sun=suns)).cause == "turning light"


def test_another_light_is_named(ball):
    assert ball.judged(ball.seen(sun=SUN * [-1, 1, -1])).cause == "light"


def test_a_table_is_named_unless_cameras_are_below_it(ball):
    for seen in (Ball(above=True), ball):
        below = np.exp(3 * (-seen.mirrored[:, 1:2] - 1)) * (seen.mirrored[:, 1:2] < 0)
        named = seen.judged(seen.truth + 0.6 * below).cause == "surroundings"
        assert named == (seen is not ball)


def test_another_object_in_half_of_the_photographs_is_named(ball):
    other = ball.seen(ball.random.permutation(ball.albedo))
    shown = np.where(ball.view[:, None] % 2, other, ball.truth)
    mean = ball.seen((ball.albedo + other.mean()) / 2)
    assert ball.judged(shown, mean).cause == "objects"


def test_shifted_photographs_are_named(ball):
    """The texture is a wave over the image; each photograph is shifted by up to 3 hundredths."""
    shifts = np.stack([np.arange(VIEWS) % 7 - 3.0, np.zeros(VIEWS)], axis=1)

    def wave(shift):
        return 1 + np.sin(ball.texel + shift[:, :1].T / 2).T * np.ones(3)

    def pixels(view, texel):
        return lambda shift: wave(shift - shifts[view])

    found = ball.judged(wave(-shifts[ball.view]), ball.noisy(wave(0 * shifts[ball.view])), pixels)
    assert found.cause == "poses" and not found.reliable


def test_a_foreign_mesh_is_named(ball):
    found = ball.judged(ball.random.random(ball.truth.shape) ** 3)
    assert found.cause == "mesh" and not found.reliable


def test_equal_samples_are_not_judged(ball):
    assert ball.judged(np.ones_like(ball.truth)) is None
    nothing = np.zeros((0, 3))
    empty = HeldOutSamples(*[np.zeros(0, int)] * 3, np.zeros(0), *[nothing] * 4)
    around = Surroundings(
        np.eye(3), ball.normal, ball.normal, ball.eyes, lambda *_: lambda _: nothing, False
    )
    assert judged(empty, around) is None


def test_photographs_without_samples_have_no_figures(ball):
    eyes = np.concatenate([ball.eyes, ball.eyes[:1]])
    seen = replace_eyes(ball, eyes)
    assert len(seen.photographs) == VIEWS + 1 and np.isnan(seen.photographs[-1].r2)


def replace_eyes(ball, eyes):
    other = Ball()
    other.eyes = eyes
    return other.judged(ball.truth)


@pytest.mark.parametrize("from_below, cause", [(0.3, "surroundings"), (0.1, "poses")])
def test_clear_causes_need_no_bad_prediction(from_below, cause):
    found = SimpleNamespace(gain=(0.3, 0.2), error=0.1, shift=(0.3,), groups=0, moving_light=0.1)
    found.from_below, found.around = from_below, SimpleNamespace(from_above=True)
    assert clear_cause(found) == cause

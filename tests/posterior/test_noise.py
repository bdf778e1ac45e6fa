"""Tests of faulty pixels: one pixel changes its texel, not the map."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

import svu_mi as svu
from svu_mi.errors import SvuWarning
from svu_mi.geometry.packed_views import pack_views

VIEW = 2


def with_hot_pixel(capture, value: float):
    """Set one pixel of view 2, in the middle of the object."""
    images = [image.copy() for image in capture.images]
    rows, columns = np.nonzero(np.isfinite(images[VIEW]).all(axis=2) & capture.masks[VIEW])
    middle = len(rows) // 2
    images[VIEW][rows[middle], columns[middle]] = value
    return replace(capture, images=tuple(images))


def off(entropy: np.ndarray, before: np.ndarray) -> float:
    """Return the fraction of texels whose entropy differs."""
    return float((np.abs(entropy - before) > 0.02).mean())


def test_a_pixel_of_1e10_is_left_out_and_its_photograph_named(vase):
    hot = with_hot_pixel(vase.capture, 1e10)
    with pytest.warns(SvuWarning, match="ignored") as caught:
        entropy = svu.estimate(hot, vase.texels).entropy.numpy()
    name = vase.capture.names[VIEW]
    sentence = str(caught[0].message)
    assert sentence.startswith(f"{name}: 1 pixel is ") and sentence.endswith(
        " times as bright as the median of the object; ignored."
    )
    before = vase.estimate.entropy.numpy()
    assert off(entropy, before) < 0.005
    assert entropy.mean() == pytest.approx(before.mean(), abs=0.002)


@pytest.mark.parametrize("value", [1e2, 1e5])
def test_a_glaring_pixel_does_not_change_the_map(vase, value):
    """The pixel could be a reflection of the sun, so it is used and changes a few texels."""
    hot = with_hot_pixel(vase.capture, value)
    with warnings.catch_warnings(action="error", category=SvuWarning):
        entropy = svu.estimate(hot, vase.texels).entropy.numpy()
    assert entropy.mean() == pytest.approx(vase.estimate.entropy.numpy().mean(), abs=0.01)


def test_valid_photographs_lose_no_pixel(vase):
    views = pack_views(vase.capture)
    with warnings.catch_warnings(action="error", category=SvuWarning):
        again = pack_views(with_hot_pixel(vase.capture, 1.0))
    assert (views.usable.numpy() == again.usable.numpy()).all()

"""Gutters against a search over all pairs of texels."""

from __future__ import annotations

import numpy as np
import pytest

from svu_mi.errors import OptionError, ShapeError
from svu_mi.geometry.dilate import dilate


def distances(valid: np.ndarray) -> np.ndarray:
    """(H, W, N) distance of every texel to each of the N valid ones."""
    rows, columns = np.indices(valid.shape)
    centers = np.argwhere(valid)
    return np.hypot(
        rows[..., None] - centers[:, 0],
        columns[..., None] - centers[:, 1],
    )


@pytest.mark.parametrize("texels", [0, 1, 1.5, 3, 100])
@pytest.mark.parametrize("shape", [(17, 23), (30, 7), (1, 12)])
def test_gutter_texels_take_the_value_of_a_nearest_valid_one(shape, texels):
    rng = np.random.default_rng(390174622)
    valid = rng.random(shape) < 0.08
    valid.flat[5] = True
    image = rng.random(shape).astype(np.float32)
    filled = dilate(image, valid, texels)
    distance = distances(valid)
    nearest = distance.min(axis=-1)
    values = image[valid]
    for i, j in np.ndindex(shape):
        if valid[i, j] or nearest[i, j] > texels:
            assert filled[i, j] == image[i, j]
        else:
            ties = distance[i, j] <= nearest[i, j] + 1e-9
            assert filled[i, j] in values[ties]


@pytest.mark.parametrize("inside", [True, False])
def test_nothing_happens_without_an_inside_or_an_outside(inside):
    image = np.arange(12, dtype=np.float32).reshape(3, 4)
    filled = dilate(image, np.full((3, 4), inside), 5)
    np.testing.assert_array_equal(filled, image)
    assert filled is not image and filled.dtype == np.float32


def test_values_of_invalid_texels_do_not_matter():
    """What lies outside the charts may be NaN; it must not leak into the gutter."""
    image = np.full((5, 5), np.nan, np.float32)
    image[2, 2] = 7
    filled = dilate(image, np.isfinite(image), 1)
    assert np.isfinite(filled).sum() == 5 and np.nansum(filled) == 35


def test_wrong_arguments_are_refused():
    image = np.zeros((4, 6), np.float32)
    with pytest.raises(ShapeError, match=r"\(4, 6\) and \(6, 4\)"):
        dilate(image, np.ones((6, 4), bool), 1)
    with pytest.raises(OptionError, match="-1"):
        dilate(image, np.ones((4, 6), bool), -1)

"""What is computed for pictures alone: the same as for files, of fewer texels and pixels."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import names, run

import svu_mi as svu
from svu_mi.capture.film_rays import SensorPixels
from svu_mi.capture.sensors import scaled_sensor
from svu_mi.capture.tonemap import block_means
from svu_mi.guidance.forecast import Forecast
from svu_mi.recovery.relighting import relight
from svu_mi.recovery.svbrdf_textures import uniform_textures


def test_the_most_probable_cell_is_that_of_the_table(vase):
    """Of all but base colour first, then of each channel's base colour given that."""
    posterior = vase.estimate.posterior
    p = np.array(posterior.probabilities, np.float64)
    rows = p[..., 0].sum(axis=-1).reshape(len(p), -1)
    bins = posterior.kernel.best(np.arange(len(p)))
    row = np.ravel_multi_index(tuple(bins[:, :-1, 0].T), p.shape[1:-2])
    best = rows.max(axis=1)
    taken = rows[np.arange(len(p)), row]
    seen = posterior.observed
    np.testing.assert_allclose(taken[seen], best[seen], rtol=1e-5)  # ties may go either way
    given = p.reshape(len(p), -1, *p.shape[-2:])[np.arange(len(p)), row]
    color = np.take_along_axis(given, bins[:, -1][:, None, :], axis=1)[:, 0]
    np.testing.assert_allclose(color[seen], given.max(axis=1)[seen], rtol=1e-5)


def test_half_a_width_is_that_of_the_least_known_channel(vase):
    """Of three channels, the one of the widest interval."""
    posterior, chosen = vase.estimate.posterior, np.arange(0, vase.texels.count, 2)
    seen = posterior.observed[chosen]
    for name in posterior.axes:
        low, high = (np.array(end) for end in posterior.interval(name, 0.9, chosen))
        half = ((high - low) / 2).reshape(len(chosen), -1)
        widths = np.array(posterior.half_width(name, 0.9, chosen))
        np.testing.assert_allclose(widths, half.max(axis=1), atol=1e-6)
    assert half.shape[1] == 3 and np.ptp(half[seen]) > 0.05


def test_chosen_pixels_equal_those_of_the_picture(vase):
    """Of 4 views in one launch and one by one: both noisy, without a bias."""
    capture, textures = vase.capture, uniform_textures(vase.texels, 0.5)
    sensors = [scaled_sensor(sensor, 32) for sensor in capture.sensors]
    inside = [part == 1 for part in SensorPixels(sensors).covered(capture.scene, capture.shape)]
    some = relight(capture, textures, None, sensors, 256, pixels=inside)
    every = relight(capture, textures, None, sensors, 256)
    for mask, one, other in zip(inside, some, every, strict=True):
        assert 0.05 < mask.mean() < 0.9 and not one[~mask].any()
        assert one[mask].mean() == pytest.approx(other[mask].mean(), rel=0.05)
        error = np.abs(one - other)[mask].mean()
        assert error < 0.2 * other[mask].mean()
    assert relight(capture, textures, None, [], 4, pixels=[]) == []


def test_shrinking_takes_means_and_keeps_what_is_not_usable():
    image = np.arange(24, dtype=np.float32).reshape(4, 6, 1).repeat(3, axis=2)
    image[0, 0] = np.nan
    small = block_means(image, 3, 2)
    assert small.shape == (2, 2, 3) and np.isnan(small[0, 0]).all()
    np.testing.assert_allclose(small[1, 1], image[2:, 3:].mean(axis=(0, 1)))


def test_views_one_by_one_are_those_of_single_steps(vase):
    candidates = svu.Candidates.around(vase.capture, 3)
    guidance = svu.next_best_view(vase.estimate, candidates, 3, texels=300)
    forecast, known = guidance._inputs.forecast, guidance._inputs.photographs
    views, added = np.arange(known), known + np.arange(3)
    expected = forecast.cumulative(views, added)
    np.testing.assert_allclose(expected, Forecast.cumulative(forecast, views, added), atol=2e-5)


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(("words", "drawn"), [
    (("entropy",), ["overview.png"]),
    (("guide", "--candidates", 6, "--add", 1), ["guidance.png", "thumbnails"]),
    (("recover", "--steps", 4), ["recovery.png", "relit.png"]),
])  # fmt: skip
def test_no_pictures_writes_all_but_pictures(shot, tmp_path, capsys, words, drawn):
    """And the last line says what was found."""
    common = (words[0], shot, *words[1:], "--resolution", 32, "-t", 2)
    assert run(*common, "-o", tmp_path) == 0
    every = names(tmp_path)
    assert set(drawn) <= set(every)
    assert run(*common, "--no-pictures", "-o", tmp_path) == 0
    assert names(tmp_path) == sorted(set(every) - set(drawn))
    wrote, told = capsys.readouterr().out.splitlines()[-2:]
    assert wrote == f"Wrote {tmp_path}"
    assert " of the surface area seen, mean entropy 0." in told
    assert told.endswith("(90 % intervals of 32×32 texels).")
    mi.set_log_level(mi.LogLevel.Warn)

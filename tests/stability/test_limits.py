"""What cannot be computed is refused with a sentence, not answered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from extremes import angular
from extremes.captures import around, ball, lamps, map_light
from extremes.estimates import WAYS
from extremes.fits import fit_error, samples
from extremes.meshes import similarity

import svu_mi as svu

METHODS = pytest.mark.parametrize("method", ["angular", "spectrum"])
BOTH = pytest.mark.parametrize("method, rule", WAYS)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return ball().capture(tmp_path_factory.mktemp("ball"))


def exposed(capture, gain, folder):
    """Light and photographs times a gain."""
    lit = ball(light=map_light(lamps() * np.float32(gain)))
    return lit.capture(folder, [image * np.float32(gain) for image in capture.images])


def test_degree_9_is_the_last():
    """dr.sh_eval ends there."""
    data = samples(2003, 40)
    found = fit_error(*data, 9)
    assert (found.errors <= found.bounds).all()
    with pytest.raises(svu.SvuError, match=r"degree must be a whole number in \[0, 9\], got 10"):
        svu.fit_sh(*data, 10)
    with pytest.raises(svu.SvuError, match=r"degree must be in \[1, 9\], got 10"):
        svu.preset("default", degree=10)


@METHODS
def test_no_light_is_refused(method, tmp_path):
    dark = ball(light={"type": "constant", "radiance": 0.0}).capture(tmp_path)
    with pytest.raises(svu.SvuError, match="is black; there is no light to reflect"):
        svu.estimate(dark, svu.texels(dark.mesh, 16), method)


@pytest.mark.few(1)
@pytest.mark.parametrize("power", [-33, 33])
@BOTH
def test_exposure_does_not_matter_within_range(method, rule, power, capture, tmp_path):
    """1e-10 to 1e10; powers of two round nothing, so nothing may change."""
    H = [
        np.array(svu.estimate(c, svu.texels(c.mesh, 16), method, rule).entropy)
        for c in (capture, exposed(capture, 2.0**power, tmp_path))
    ]
    np.testing.assert_allclose(H[1], H[0], atol=16 * 2.0**-24)


@pytest.mark.parametrize("power", [-100, 100])
@METHODS
def test_radiance_out_of_range_is_refused(method, power, capture, tmp_path):
    """Squares of 1e-30 and of 1e30 are 0 and infinite in single precision."""
    faint = exposed(capture, 2.0**power, tmp_path)
    with pytest.raises(svu.SvuError, match="radiance"):
        svu.estimate(faint, svu.texels(faint.mesh, 16), method)


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
@pytest.mark.parametrize("gain, scale", [(1.0, 1e-25), (1e20, 0.7)])
def test_no_radiance_makes_the_marginal_rule_nan(gain, scale):
    """What no roughness explains is a square: 0 times infinity, and infinity less infinity."""
    switches = svu.preset("fixed", method="angular", noise="marginal")
    w, b, *light = angular.samples(7, 1)
    statistics = angular.statistics_of((w, gain * b, *light))
    H = np.array(svu.angular_posterior(statistics, None, scale, switches).entropy())
    assert ((H >= 0) & (H <= 1)).all()


@pytest.mark.few(1)
@BOTH
def test_a_single_texel_is_enough(method, rule, capture):
    found = svu.estimate(capture, svu.texels(capture.mesh, 1), method, rule)
    H = np.array(found.entropy)
    assert H.shape == (1,)
    assert 0 <= H[0] < 1


@METHODS
def test_no_view_is_refused(method, capture, tmp_path):
    texels = svu.texels(capture.mesh, 16)
    with pytest.raises(svu.SvuError):
        svu.estimate(replace(capture, used=(False,) * capture.count), texels, method)
    empty = ball(directions=around(0)).capture(tmp_path, [])
    with pytest.raises(svu.SvuError):
        svu.estimate(empty, svu.texels(empty.mesh, 16), method)


@pytest.mark.parametrize("extents", [1e1, 1e3])
def test_texels_stay_visible_far_from_the_origin(extents, capture, tmp_path):
    """Rays that start closer to a surface than coordinates resolve hit it."""
    there = ball(to_world=similarity(1.0, extents * 12**0.5)).capture(tmp_path, capture.images)
    before, after = (
        np.array(svu.estimate(c, svu.texels(c.mesh, 16)).coverage) for c in (capture, there)
    )
    assert (before != after).mean() < 0.02  # those at the border of visibility


@pytest.mark.parametrize("extents", [1e4, 1e5])
def test_what_single_precision_cannot_place_is_refused(extents, capture, tmp_path):
    there = ball(to_world=similarity(1.0, extents * 12**0.5)).capture(tmp_path, capture.images)
    with pytest.raises(svu.SvuError):
        svu.estimate(there, svu.texels(there.mesh, 16))

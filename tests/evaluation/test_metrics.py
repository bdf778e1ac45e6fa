"""Metrics against hand-computed cases, and the properties that define them."""

from __future__ import annotations

import numpy as np
import pytest
from support.helpers import ball_scene, memory_capture

from svu_mi.bench.correlation import Interval, mean_over_objects, pearson, sparsification, spearman
from svu_mi.bench.credible_sets import credible_coverage, nearest_bins
from svu_mi.bench.error_summary import error_summary
from svu_mi.bench.image_metrics import image_error, ssim_map, texel_error, texture_psnr
from svu_mi.capture.rendering import render_capture
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.errors import OptionError, SceneError, ShapeError
from svu_mi.evaluation.ground_truth import ground_truth
from svu_mi.evaluation.psnr import CEILING_DB, psnr
from svu_mi.geometry.texels import texels
from svu_mi.scenes import path

SEED = 90417


@pytest.fixture
def rng():
    return np.random.default_rng(SEED)


# --- correlation --------------------------------------------------------------------------


def test_pearson_by_hand():
    """x = 0 1 2, y = 0 1 4: covariance 2 / 1.0, deviations sqrt(2) and sqrt(26/3)."""
    assert pearson([0, 1, 2], [0, 1, 4]) == pytest.approx(4 / np.sqrt(2 * 26 / 3))
    assert pearson([0, 1, 2], [2, 1, 0]) == pytest.approx(-1)


def test_spearman_sees_only_the_order():
    assert spearman([0, 1, 2, 3], [0, 1, 10, 1000]) == pytest.approx(1)
    # Ties share their mean rank: 1.5 1.5 3 against 1 2 3.
    assert spearman([5, 5, 9], [1, 2, 3]) == pytest.approx(np.sqrt(3) / 2)


@pytest.mark.parametrize("rho", [pearson, spearman])
@pytest.mark.parametrize("constant", [[0.0] * 4, [0.1] * 4, [1e9] * 4, [0.3 + 1e-17, 0.3] * 2])
def test_a_constant_correlates_with_nothing(rho, constant):
    assert rho(constant, [1, 2, 3, 5]) == 0
    assert rho([1, 2, 3, 5], constant) == 0
    assert rho([1.0], [2.0]) == 0


@pytest.mark.parametrize("function", [pearson, spearman, sparsification,
                                      error_summary])  # fmt: skip
def test_shapes_and_numbers_are_checked(function):
    for values, others, sentence in (([1, 2, 3], [1, 2], r"\(3,\) array, got \(2,\)"),
                                     ([], [], "non-empty"),
                                     ([[1, 2]], [1, 2], r"got \(1, 2\)")):  # fmt: skip
        with pytest.raises(ShapeError, match=sentence):
            function(values, others)
    with pytest.raises(OptionError, match="1 values that are NaN"):
        function([1, 2], [np.nan, 1])


# --- mean over cells ----------------------------------------------------------------------


def test_objects_are_resampled_not_cells():
    """Thirty equal cells of three objects tell no more than one cell of each."""
    few = mean_over_objects([0.2, 0.5, 0.8], ["a", "b", "c"])
    many = mean_over_objects(np.repeat([0.2, 0.5, 0.8], 10), np.repeat(["a", "b", "c"], 10))
    assert few.mean == pytest.approx(0.5)
    # All three draws the same: 1 in 27, above 2.5 %; t with 2 degrees of freedom is 4.303.
    assert few.low == pytest.approx(0.5 - 0.3 * np.sqrt(3 / 2) * 4.3027 / 1.95996, abs=1e-4)
    assert (many.mean, many.low, many.high) == (
        pytest.approx(few.mean), pytest.approx(few.low), pytest.approx(few.high)
    )  # fmt: skip
    assert many.objects == 3


@pytest.mark.parametrize("count", [3, 4, 6, 10, 30])
def test_interval_covers_the_mean_with_its_probability(rng, count):
    """Objects of 3 cells: 95 %."""
    names = np.repeat(np.arange(count).astype(str), 3)
    held = 0
    for index in range(200):
        cells = np.repeat(rng.normal(0.7, 0.1, count), 3) + rng.normal(0, 0.02, 3 * count)
        result = mean_over_objects(cells, names, seed=index)
        held += result.low <= 0.7 <= result.high
    assert 0.9 <= held / 200 <= 0.995


def test_one_or_two_objects_have_a_mean_and_no_interval():
    for objects, count in ((["a", "a"], 1), (["a", "b"], 2)):
        result = mean_over_objects([0.5, 0.7], objects)
        assert result == Interval(pytest.approx(0.6), None, None, count)
    with pytest.raises(ShapeError, match=r"\(1,\) array"):
        mean_over_objects([0.5, 0.7], ["a"])


# --- sparsification -----------------------------------------------------------------------


def test_sparsification_by_hand():
    """Errors 1 2 3 (mean 2). The oracle removes 3, then 2: 1, 3/4, 1/2. The uncertainty removes
    1, then 2: 1, 5/4, 3/2. The area between: trapezoids of 0, 1/2, 1 with step 1/3."""
    curves = sparsification([1, 2, 3], [0.9, 0.5, 0.1])
    np.testing.assert_allclose(curves.removed, [0, 1 / 3, 2 / 3])
    np.testing.assert_allclose(curves.oracle, [1, 3 / 4, 1 / 2])
    np.testing.assert_allclose(curves.by_uncertainty, [1, 5 / 4, 3 / 2])
    assert curves.ause == pytest.approx(1 / 3)
    assert curves.relative == pytest.approx(2)  # as much worse than chance as the oracle is better


def test_a_perfect_order_has_no_area_and_no_order_is_chance(rng):
    error = rng.exponential(size=500)
    assert sparsification(error, error**3).ause == 0
    constant = sparsification(error, np.full(500, 0.3))
    np.testing.assert_allclose(constant.by_uncertainty, 1)
    assert constant.relative == pytest.approx(1)
    noise = [sparsification(error, rng.random(500)).relative for _ in range(20)]
    assert np.mean(noise) == pytest.approx(1, abs=0.15)


def test_sparsification_without_errors():
    for error in ([0.0, 0.0, 0.0], [0.5, 0.5, 0.5], [2.0]):
        curves = sparsification(error, np.arange(len(error)))
        assert (curves.ause, curves.relative) == (0, 0)
        np.testing.assert_allclose(curves.by_uncertainty, 1)
    with pytest.raises(OptionError, match="negative"):
        sparsification([-1, 1], [0, 1])


# --- credible sets ------------------------------------------------------------------------


def test_the_truth_falls_into_the_nearest_cell():
    axes = {"roughness": [0, 0.5, 1], "specular": [0, 1]}
    truth = {"roughness": [0.1, 0.26, 0.9], "specular": [0.2, 0.9, 0.5], "other": [1, 2, 3]}
    np.testing.assert_array_equal(nearest_bins(axes, truth), [0, 3, 4])


def test_credible_sets_by_hand():
    """0.5 needs the first cell; 0.9 needs 0.6, 0.3 and, to be whole, nothing more."""
    p = np.array([[0.6, 0.3, 0.1]] * 3)
    half = credible_coverage(p, np.array([0, 1, 2]), 0.5)
    assert (half.plain, half.size) == (pytest.approx(1 / 3), pytest.approx(1 / 3))
    assert half.fractional == pytest.approx(0.5 / 0.6 / 3)
    most = credible_coverage(p, np.array([0, 1, 2]), 0.9)
    assert (most.plain, most.size) == (pytest.approx(2 / 3), pytest.approx(2 / 3))
    assert most.fractional == pytest.approx(2 / 3)


def test_ties_are_taken_in_whole():
    p = np.full((4, 2, 2), 0.25)
    coverage = credible_coverage(p, np.arange(4), 0.5)
    assert (coverage.plain, coverage.size) == (1, 1)
    assert coverage.fractional == pytest.approx(0.5)


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_coverage_of_a_calibrated_posterior_is_its_level(rng, level):
    """Truth drawn from each posterior: the level within four binomial deviations."""
    count = 4000
    p = rng.dirichlet(np.full(64, 0.1), count)
    truth = (p.cumsum(axis=1) > rng.random((count, 1))).argmax(axis=1)
    coverage = credible_coverage(p.reshape(count, 8, 8).astype(np.float32), truth, level)
    margin = 4 * np.sqrt(level * (1 - level) / count)
    assert coverage.fractional == pytest.approx(level, abs=margin)
    assert coverage.plain >= level - margin
    assert 0 < coverage.size < level


def test_a_truth_without_probability_is_not_covered():
    p = np.array([[1.0, 0.0]] * 2)
    coverage = credible_coverage(p, np.array([0, 1]), 0.9)
    assert coverage.plain == 0.5
    assert coverage.fractional == pytest.approx(0.45)


def test_what_credible_coverage_refuses():
    p = np.full((2, 4), 0.25)
    with pytest.raises(ShapeError, match=r"must be \(2,\) integers"):
        credible_coverage(p, np.array([0]), 0.5)
    with pytest.raises(ShapeError, match="outside the grid of 4"):
        credible_coverage(p, np.array([0, 4]), 0.5)
    with pytest.raises(OptionError, match="sums are 2"):
        credible_coverage(2 * p, np.array([0, 1]), 0.5)
    with pytest.raises(OptionError, match="level"):
        credible_coverage(p, np.array([0, 1]), 1)


# --- errors and truth ---------------------------------------------------------------------


def test_errors_by_hand():
    result = error_summary([1, 2, 6], [1, 3, 3])
    assert result.bias == pytest.approx(2 / 3)
    assert result.mae == pytest.approx(4 / 3)
    assert result.rmse == pytest.approx(np.sqrt(10 / 3))


def test_the_truth_of_a_scene_is_its_textures():
    """The vase's band is metal; a lookup by hand in the texture's pixels agrees."""
    from svu_mi.core.io.exr import read_exr

    capture = render_capture(path("vase"), 1, views=1, resolution=(8, 8))
    grid = texels(capture.mesh, 64)
    truth = ground_truth(capture, grid)
    picture = read_exr(path("vase").parent / "metallic.exr")
    pixels = next(iter(picture.values()))
    side = len(pixels) // 64
    # The centre of a texel is the corner of four pixels; bilinear lookup is their mean.
    blocks = pixels.reshape(64, side, 64, side)[:, side // 2 - 1 : side // 2 + 1, :,
                                                 side // 2 - 1 : side // 2 + 1]  # fmt: skip
    np.testing.assert_allclose(
        truth.metallic, blocks.mean(axis=(1, 3)).ravel()[np.array(grid.index)], atol=1e-5
    )
    assert truth.metallic.min() == 0
    assert truth.metallic.max() == 1
    metal, matte = truth.metallic == 1, truth.metallic == 0
    np.testing.assert_allclose(truth.specular[metal], truth.base_color[metal])
    np.testing.assert_allclose(truth.specular[matte], 0.04)
    np.testing.assert_allclose(truth.grey("base_color"), truth.base_color.mean(axis=1))
    assert truth.grey("roughness").shape == (grid.count,)
    np.testing.assert_array_equal(truth.grey("specular"), truth.specular.mean(axis=1))
    with pytest.raises(OptionError, match="Unknown parameter 'rouhgness'; use one of base_color"):
        truth.grey("rouhgness")


def test_uniform_parameters_and_other_materials(tmp_path):
    light = {"type": "constant"}
    paint = {"type": "principled", "roughness": 0.25, "metallic": 0.75,
             "base_color": {"type": "rgb", "value": [0.25, 0.5, 1.0]}}  # fmt: skip
    scene = ball_scene(tmp_path, light, paint)
    capture = memory_capture(scene, [np.ones((8, 8, 3), np.float32)],
                             sphere_sensors(scene.shapes()[0], 1, (8, 8)))  # fmt: skip
    grid = texels(capture.mesh, 16)
    truth = ground_truth(capture, grid)
    np.testing.assert_allclose(truth.base_color, [[0.25, 0.5, 1.0]] * grid.count, rtol=1e-6)
    np.testing.assert_allclose(truth.roughness, 0.25)
    np.testing.assert_allclose(truth.metallic, 0.75)
    scene = ball_scene(tmp_path, light, {"type": "diffuse"})
    capture = memory_capture(scene, [np.ones((8, 8, 3), np.float32)],
                             sphere_sensors(scene.shapes()[0], 1, (8, 8)))  # fmt: skip
    with pytest.raises(SceneError, match="principled"):
        ground_truth(capture, grid)


# --- textures and pictures -----------------------------------------------------------------


def test_psnr_is_that_of_the_definition():
    rng = np.random.default_rng(771204316)
    truth = rng.uniform(size=(50, 3))
    assert psnr(truth + 0.1, truth) == pytest.approx(20)  # MSE 1e-2
    noisy = truth + rng.normal(scale=0.05, size=truth.shape)
    by_hand = 10 * np.log10(truth.size / ((noisy - truth) ** 2).sum())
    assert psnr(noisy, truth) == pytest.approx(by_hand)


@pytest.mark.parametrize(
    ("estimate", "truth", "error"),
    [
        ([1.0], [1.0, 2.0], ShapeError),
        ([], [], ShapeError),
        ([np.nan], [1.0], OptionError),
    ],
)
def test_psnr_refuses_what_it_cannot_compare(estimate, truth, error):
    with pytest.raises(error):
        psnr(estimate, truth)


def test_the_average_counts_every_parameter_the_same():
    truth = {"base_color": np.zeros((4, 3)), "roughness": np.zeros(4)}
    result = {"base_color": np.full((4, 3), 0.1), "roughness": np.full(4, 0.01)}
    assert texture_psnr(result, truth) == pytest.approx(
        {"base_color": 20, "roughness": 40, "average": 30}
    )
    np.testing.assert_allclose(texel_error(result, truth), 0.055)  # (0.1 + 0.01) / 2
    with pytest.raises(ShapeError, match="base_color"):
        texture_psnr({"roughness": result["roughness"]}, truth)


def ssim_of_windows(estimate, truth):
    """SSIM as the sum over each 11 x 11 window that Wang et al. write down (Eq. 13 to 16)."""
    at = np.arange(-5, 6)
    weight = np.exp(-(at**2) / (2 * 1.5**2))
    weight = np.outer(weight, weight)
    weight /= weight.sum()
    padded = [np.pad(x, ((5, 5), (5, 5)), mode="symmetric") for x in (estimate, truth)]
    result = np.empty(estimate.shape)
    for i, j in np.ndindex(*estimate.shape):
        x, y = (p[i : i + 11, j : j + 11] for p in padded)
        mx, my = (weight * x).sum(), (weight * y).sum()
        sx, sy = (weight * (x - mx) ** 2).sum(), (weight * (y - my) ** 2).sum()
        sxy = (weight * (x - mx) * (y - my)).sum()
        c1, c2 = 0.01**2, 0.03**2
        result[i, j] = (2 * mx * my + c1) * (2 * sxy + c2)
        result[i, j] /= (mx**2 + my**2 + c1) * (sx + sy + c2)
    return result


def test_ssim_is_that_of_wang_et_al():
    rng = np.random.default_rng(40927715)
    truth = rng.uniform(size=(14, 17))
    result = np.clip(truth + rng.normal(scale=0.2, size=truth.shape), 0, 1)
    # Border pixels are mirrored in both, so every pixel can be compared.
    np.testing.assert_allclose(
        ssim_map(result[..., None], truth[..., None])[..., 0], ssim_of_windows(result, truth),
        rtol=1e-9,
    )  # fmt: skip


def test_pictures_are_compared_on_the_object_at_any_exposure():
    rng = np.random.default_rng(5582210)
    truth, mask = rng.uniform(0.2, 2, size=(16, 16, 3)), np.zeros((16, 16), bool)
    mask[4:12, 4:12] = True
    result = truth * 1.1
    same = image_error(truth, truth, mask)
    assert (same.psnr_hdr, same.psnr_ldr, same.ssim) == (CEILING_DB, CEILING_DB, pytest.approx(1))
    error = image_error(result, truth, mask)
    assert 15 < error.psnr_hdr < 40
    result[0, 0] = np.nan  # not on the object
    assert image_error(result, truth, mask) == error
    brighter = image_error(1000 * result, 1000 * truth, mask)
    assert brighter.psnr_hdr == pytest.approx(error.psnr_hdr)
    assert brighter.ssim == pytest.approx(error.ssim)
    with pytest.raises(ShapeError, match="empty"):
        image_error(truth, truth, np.zeros((16, 16), bool))


def test_sparsification_does_not_depend_on_units_or_order(rng):
    error, said = rng.exponential(size=200), rng.integers(0, 20, 200)
    order = rng.permutation(200)
    first = sparsification(error, said)
    other = sparsification(7 * error[order], np.exp(said[order] / 3))
    assert other.ause == pytest.approx(first.ause)


def test_without_any_error_psnr_is_a_number():
    assert psnr([0.5], [0.5]) == CEILING_DB

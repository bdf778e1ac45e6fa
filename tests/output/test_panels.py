"""Building blocks of figures: what stands where, in which colour."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from svu_mi.capture.tonemap import ObjectView, object_only_scene
from svu_mi.errors import OptionError
from svu_mi.evaluation.ground_truth import GroundTruth
from svu_mi.output.panels import (
    draw_look,
    draw_map,
    draw_marginal,
    draw_photograph,
    draw_posterior,
    fully_seen,
    map_colors,
)
from svu_mi.output.style import OUTSIDE, UNSEEN
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.tabulated import tabulated_posterior


@pytest.fixture(scope="module")
def estimate(vase):
    """The first half of the texels unseen, all others with an entropy of 0.25."""
    seen = np.arange(vase.texels.count) >= vase.texels.count // 2
    entropy = np.where(seen, np.float32(0.25), 1)
    return SimpleNamespace(texels=vase.texels, coverage=seen.astype(np.uint32), entropy=entropy)


def axes():
    return Figure().add_subplot()


def shown(place) -> list[np.ndarray]:
    return [np.ma.filled(image.get_array(), np.nan) for image in place.get_images()]


def test_a_photograph_is_cropped_to_its_mask():
    red = np.broadcast_to(np.float32([0.5, 0, 0]), (20, 30, 3))
    mask = np.zeros((20, 30), bool)
    mask[5:10, 10:15] = True
    capture = SimpleNamespace(images=(red, red), masks=(None, mask), clipped=())
    whole, part = axes(), axes()
    draw_photograph(whole, capture, 0)
    draw_photograph(part, capture, 1)
    assert shown(whole)[0].shape == (20, 30, 3)
    height, width = shown(part)[0].shape[:2]
    assert 5 <= height <= 8 and 5 <= width <= 8
    # Exposed for the 95th percentile, which is the red itself: full red, to float32's rounding.
    np.testing.assert_allclose(shown(part)[0] - [1, 0, 0], 0, atol=1e-6)


def test_maps_are_grey_where_they_have_no_value(estimate):
    place = axes()
    drawn = draw_map(place, estimate)
    image, cover = shown(place)
    seen = estimate.texels.to_image(estimate.coverage > 0, False)
    inside = estimate.texels.inside()
    assert drawn.get_clim() == (0, 1)
    np.testing.assert_array_equal(image[seen], np.float32(0.25))
    np.testing.assert_array_equal(cover[seen, 3], 0)
    assert (inside & ~seen).any() and not inside.all()
    assert (cover[inside & ~seen] == np.float32([*UNSEEN, 1])).all()
    assert (cover[~inside] == np.float32([*OUTSIDE, 1])).all()


def test_on_the_object_are_the_colours_of_the_map(vase):
    place, twos = axes(), np.full(vase.texels.count, 2.0)
    scale = {"limits": (0, 2), "colormap": "Reds"}
    look = ObjectView.at(object_only_scene(vase.capture), vase.capture.sensors[0])
    draw_look(place, look, map_colors(fully_seen(vase.texels), twos, **scale))
    image = shown(place)[0]
    middle, corner = image[image.shape[0] // 2, image.shape[1] // 2], image[0, 0]
    np.testing.assert_allclose(corner, 1)
    # The last colour of Reds, a little darker by the shading.
    assert middle[0] > 0.3 and middle[1] < 0.02 and middle[2] < 0.1


def posterior(grid, cell) -> Posterior:
    """Two texels: uniform; and all in one cell."""
    energies = np.zeros((2, *grid.shape))
    energies[1] = 60
    energies[(1, *cell)] = 0
    return tabulated_posterior(energies, grid, np.ones(2, bool))


def test_a_posterior_has_its_mode_where_it_belongs():
    of = posterior(PrincipledGrid(5, 3, 4), (1, 2, 3))
    for names in (None, ("roughness", "metallic"), ("metallic", "roughness")):
        p = shown_mesh(axes(), of, 1, names)
        x, y = names or ("roughness", "metallic")
        where = {"roughness": 1, "metallic": 2}
        assert p.shape == (len(of.axes[y]), len(of.axes[x]))
        assert p[where[y], where[x]] == pytest.approx(1)
    uniform = shown_mesh(axes(), of, 0, ("roughness", "base_color"))
    np.testing.assert_allclose(uniform, np.full((4, 5), 1 / 20), rtol=1e-6)


def shown_mesh(place, of, texel, names) -> np.ndarray:
    drawn = draw_posterior(place, of, texel, names)
    assert drawn.get_clim() == (0, drawn.get_array().max())
    return np.array(drawn.get_array())


def test_the_truth_is_marked():
    of = posterior(ParameterGrid(5, 4, "dielectric"), (1, 2))
    truth = GroundTruth(
        base_color=np.array([[0.5, 0.5, 0.5], [0.3, 0.6, 0.9]]),
        roughness=np.array([0.1, 0.7]),
        metallic=np.array([0.0, 1.0]),
    )
    place = axes()
    draw_posterior(place, of, 1, truth=truth)
    for line in place.get_lines():
        np.testing.assert_allclose(line.get_xydata(), [[0.7, 0.6]])
    assert place.get_xlabel() == "roughness" and place.get_ylabel() == "specular (Ks)"
    place = axes()
    draw_marginal(place, of, 1, "specular", truth=truth)
    np.testing.assert_allclose(place.get_lines()[-1].get_xdata(), 0.6)


def test_a_marginal_has_a_bar_around_every_node():
    grid = ParameterGrid(5, 4, "dielectric")
    place = axes()
    draw_marginal(place, posterior(grid, (1, 2)), 1, "specular")
    bars = place.patches
    np.testing.assert_allclose([bar.get_height() for bar in bars], [0, 0, 1, 0], atol=1e-6)
    for node, bar in zip(grid.specular_nodes, bars, strict=True):
        assert bar.get_x() <= node <= bar.get_x() + bar.get_width()
    place = axes()
    draw_marginal(place, posterior(grid, (1, 2)), 0, "roughness")
    np.testing.assert_allclose([bar.get_height() for bar in place.patches], 0.2, rtol=1e-6)


@pytest.mark.parametrize("names", [("roughness", "gloss"), ("roughness", "roughness")])
def test_parameters_that_make_no_picture_are_refused(names):
    of = posterior(PrincipledGrid(3, 3, 3), (0, 0, 0))
    with pytest.raises(OptionError, match="expected two of roughness, metallic, base_color"):
        draw_posterior(axes(), of, 0, names)
    with pytest.raises(OptionError, match="gloss"):
        draw_marginal(axes(), of, 0, "gloss")

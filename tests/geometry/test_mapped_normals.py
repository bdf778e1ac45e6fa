"""Normal and bump maps: normals of texels are those with which Mitsuba shades."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball

from svu_mi.capture.mesh import make_mesh
from svu_mi.capture.normal_map import normal_map
from svu_mi.errors import MeshError
from svu_mi.geometry.texels import texels

SIZE, FINE = (7, 5), (24, 18)  # pixels of the maps, and finer texels
PAINT = {"type": "principled"}


def bitmap(pixels):
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.asarray(pixels, np.float32))}


def tilted(seed=6103):
    """A map of normals at most 40 degrees from the z axis."""
    rng = np.random.default_rng(seed)
    pixels = np.dstack([rng.uniform(-0.6, 0.6, (SIZE[1], SIZE[0], 2)), np.ones(SIZE[::-1])])
    return bitmap(pixels / np.linalg.norm(pixels, axis=2, keepdims=True) / 2 + 0.5)


def bumps():
    return bitmap(np.random.default_rng(2207).uniform(0, 0.2, (SIZE[1], SIZE[0], 1)))


def on_ball(bsdf, flip=False):
    """A ball of one chart with a BSDF; its normals point inwards if flipped."""
    flat, props = ball(), mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    if flip:
        props["flip_normals"] = True
    return make_mesh("ball", flat, props)


MAPS = {
    "normals": lambda: {"type": "normalmap", "normalmap": tilted(), "paint": PAINT},
    "bumps": lambda: {"type": "bumpmap", "heights": bumps(), "scale": 2.0, "paint": PAINT},
}


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("kind", MAPS)
def test_normals_are_those_of_mitsuba(kind, flip):
    """A white diffuse BSDF within a map is the cosine with the tilted normal / pi."""
    white = {"type": "diffuse", "reflectance": 1.0}
    bsdf = MAPS[kind]() | {"paint": white, "use_shadowing_function": False}
    mesh = on_ball(bsdf, flip)
    grid, smooth = (texels(each, FINE) for each in (mesh, on_ball(PAINT, flip)))
    toward = mi.Vector3f(grid.geometric_normal)
    scene = mi.load_dict({"type": "scene", "ball": mesh})
    si = scene.ray_intersect(mi.Ray3f(grid.position + 0.01 * toward, -toward))
    rng = np.random.default_rng(8107)
    random = mi.Point2f(rng.uniform(size=(2, grid.count)).astype(np.float32))
    outgoing = mi.warp.square_to_cosine_hemisphere(random)
    expected = np.pi * np.array(mesh.bsdf().eval(mi.BSDFContext(), si, outgoing))[0]
    found = np.array(dr.dot(grid.normal, si.to_world(outgoing)))
    lit = expected > 0  # Mitsuba omits directions below one of the two horizons
    assert lit.mean() > 0.9
    if kind == "bumps":  # slopes jump between pixels, where texels have the mean of both sides
        lit &= inside_pixels(grid)
        assert lit.mean() > 0.4
    # Slopes change within a texel.
    tolerance = 6e-3 if kind == "bumps" else 1e-4
    np.testing.assert_allclose(found[lit], expected[lit], atol=tolerance)
    across = np.array(dr.dot(grid.normal, smooth.normal))
    assert np.median(across) < 0.98  # more than 11 degrees
    outward = np.array(dr.dot(grid.normal, mi.Normal3f(grid.position)))
    assert np.median(outward) * (-1 if flip else 1) > 0.5


def inside_pixels(grid):
    """Return whether each texel lies between the centres of four pixels of the map."""
    inside = True
    for at, pixels, count in zip(np.array(grid.uv), SIZE, FINE, strict=True):
        low, high = (np.floor(pixels * (at + side / count) - 0.5) for side in (-0.5, 0.5))
        inside &= low == high
    return inside


def test_both_sides_have_the_map_of_the_front():
    inner = MAPS["normals"]()
    mapped = texels(on_ball(inner), SIZE).normal
    two = on_ball({"type": "twosided", "inner": inner})
    np.testing.assert_array_equal(texels(two, SIZE).normal, mapped)
    assert normal_map(two.bsdf()).class_name() == "NormalMap"
    assert normal_map(mi.load_dict(PAINT)) is None


def test_flat_maps_change_nothing():
    plain = np.array(texels(on_ball(PAINT), SIZE).normal)
    flat = {"type": "normalmap", "normalmap": bitmap(np.full((2, 3, 3), [0.5, 0.5, 1])), "a": PAINT}
    level = {"type": "bumpmap", "heights": bitmap(np.full((2, 3, 1), 0.7)), "a": PAINT}
    for bsdf in (flat, level):
        np.testing.assert_allclose(np.array(texels(on_ball(bsdf), SIZE).normal), plain, atol=1e-5)


def test_fine_maps_are_averaged():
    """Stripes that tilt by turns to both sides are flat on average."""
    pixels = np.full((2 * FINE[1], 2 * FINE[0], 3), [0.9, 0.5, 0.9])
    pixels[:, ::2, 0] = 0.1
    stripes = {"type": "normalmap", "normalmap": {**bitmap(pixels), "filter_type": "nearest"}}
    plain = np.array(texels(on_ball(PAINT), FINE).normal)
    found = np.array(texels(on_ball({**stripes, "a": PAINT}), FINE).normal)
    np.testing.assert_allclose(found, plain, atol=1e-4)


def test_map_that_has_no_normals_is_refused():
    grey = {"type": "normalmap", "normalmap": bitmap(np.full((2, 3, 1), 0.5)), "a": PAINT}
    with pytest.raises(MeshError, match="Shape '.*': its normal or bump map cannot be read .*use"):
        texels(on_ball(grey), SIZE)

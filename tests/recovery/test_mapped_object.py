"""An object with a normal map: its estimate, its copy with textures, and the recovered scene."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import STUDIO, ball, memory_capture, render_views

import svu_mi as svu
from svu_mi.capture.content_hash import photographs_key
from svu_mi.capture.mesh import make_mesh
from svu_mi.capture.replace_material import make_scene
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.output.texture_files import write_scene
from svu_mi.recovery.path.textured_scene import PathScene
from svu_mi.recovery.svbrdf_textures import scene_textures

PAINT = {
    "type": "principled", "base_color": {"type": "rgb", "value": [0.6, 0.4, 0.2]},
    "roughness": 0.3, "metallic": 0.0,
}  # fmt: skip
SIZE = (20, 14)  # texels
PIXELS = (5, 4)  # of the map


def capture_of(bsdf, views=32):
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    mesh = make_mesh("ball", ball(), props)
    scene = make_scene([mi.load_dict({"type": "direct"}), mi.load_dict(STUDIO), mesh])
    sensors = sphere_sensors(scene.shapes()[0], views, (64, 48))
    return memory_capture(scene, render_views(scene, sensors, 16), sensors)


def tilted(bsdf=PAINT):
    """Normals that are tilted by up to 30 degrees."""
    rng = np.random.default_rng(9157)
    pixels = np.dstack([rng.uniform(-0.4, 0.4, (PIXELS[1], PIXELS[0], 2)), np.ones(PIXELS[::-1])])
    pixels /= np.linalg.norm(pixels, axis=2, keepdims=True)
    bitmap = mi.Bitmap((pixels / 2 + 0.5).astype(np.float32))
    texture = {"type": "bitmap", "raw": True, "bitmap": bitmap}
    return {"type": "normalmap", "normalmap": texture, "paint": bsdf}


@pytest.fixture(scope="module")
def mapped():
    return capture_of({"type": "twosided", "inner": tilted()})


def with_bsdf(capture, bsdf):
    """The same photographs, of an object that the scene describes by another BSDF."""
    other = capture_of(bsdf, 1)
    return replace(capture, scene=other.scene, shape=other.shape, mesh=other.mesh)


def test_map_explains_the_photographs(mapped):
    """Without it, roughness and base colour are wrong where normals are tilted."""
    errors = []
    for capture in (mapped, with_bsdf(mapped, PAINT)):
        estimate = svu.estimate(capture, svu.texels(capture.mesh, SIZE), preset="fixed")
        seen = np.array(estimate.coverage) >= 6
        assert seen.sum() > 40
        color = np.array(estimate.posterior.mean("base_color")).reshape(len(seen), -1).mean(1)
        rough = np.array(estimate.posterior.mean("roughness"))[seen]
        errors.append([np.abs(color[seen] - 0.4).mean(), np.abs(rough - 0.3).mean()])
    (color, rough), (color_without, rough_without) = errors
    assert color < 0.7 * color_without
    assert rough < 0.9 * rough_without


def test_other_maps_are_other_captures(mapped):
    assert photographs_key(mapped) != photographs_key(with_bsdf(mapped, PAINT))
    again = with_bsdf(mapped, {"type": "twosided", "inner": tilted()})
    assert photographs_key(mapped) == photographs_key(again)


@pytest.mark.parametrize("recovered", [False, True])
def test_copies_have_the_map(mapped, recovered, tmp_path):
    """Rendered alike, by the path tracer and from ``recovered.xml``."""
    grid = svu.texels(mapped.mesh, SIZE)
    textures = scene_textures(mapped, grid)
    scene = PathScene.of(mapped, textures).scene
    if recovered:
        scene = mi.load_file(str(write_scene(mapped, textures, tmp_path)))
    integrator = mi.load_dict({"type": "direct"})
    image, expected, without = (
        np.array(mi.render(each, sensor=mapped.sensors[0], integrator=integrator, spp=64, seed=1))
        for each in (scene, mapped.scene, with_bsdf(mapped, PAINT).scene)
    )
    assert np.abs(image - expected).mean() < 0.1 * np.abs(without - expected).mean()

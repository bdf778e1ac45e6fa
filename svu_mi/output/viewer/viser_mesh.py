"""Object and cameras for viser's page: a textured mesh, and frusta with photographs.

three.js, which renders the page, applies a fit of the ACES filmic curve to all colours (S. Hill,
BakingLab, as in three.js's ``tonemapping_pars_fragment``). The inverse curve is applied to
textures, so that object, colour bar and photographs have the same colours. Frusta use OpenCV's
axes: +X right, +Y down, +Z forward.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from svu_mi.capture import mesh as meshes
from svu_mi.capture.capture import Capture
from svu_mi.capture.image_io import decoded, quantized, srgb
from svu_mi.capture.importers.source import OPENCV
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import film_size, focal_length, principal_point
from svu_mi.capture.tonemap import tone_mapped, with_bounds

LIGHT_STRENGTH = 4.0  # factor of texture colours: white needs more than a texture value of 1
EXPOSURE = 0.6
TO_ACES = np.array([
    [0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777],
])  # fmt: skip
FROM_ACES = np.array([
    [1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602],
])  # fmt: skip
# y = (x^2 + B x - C) / (D x^2 + E x + F)
B, C, D, E, F = 0.0245786, 0.000090537, 0.983729, 0.4329510, 0.238081


def textured_mesh(mesh: Any, colors: np.ndarray) -> Any:
    """Return an ``mi.Mesh`` with UVs as a ``trimesh.Trimesh``.

    ``colors`` (H, W, 3) is how the texture appears on screen under the page's white light.
    """
    source = meshes.arrays(mesh)
    assert source.uvs is not None
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(material_colors(colors)), metallicFactor=0.0,
        roughnessFactor=1.0, doubleSided=True,
    )  # fmt: skip
    # trimesh flips V when it writes glTF, whose v = 0 is the top row of an image.
    uvs = meshes.flipped_v(source.uvs)
    visual = trimesh.visual.TextureVisuals(uv=uvs, material=material)
    return trimesh.Trimesh(source.positions, source.faces, visual=visual, process=False)


def material_colors(colors: np.ndarray) -> np.ndarray:
    """Return the uint8 material colours that produce screen colours under the light."""
    return quantized(srgb(before_tone_mapping(decoded(colors))))


def before_tone_mapping(linear: np.ndarray) -> np.ndarray:
    """Return the texture that produces linear colours (..., 3) under ``LIGHT_STRENGTH``.

    The tone curve does not reach white and the most saturated colours. They become slightly grey
    and slightly paler, respectively.
    """
    curve = np.clip(linear @ np.linalg.inv(FROM_ACES).T, 0, 1)
    a, b, c = 1 - D * curve, B - E * curve, -(C + F * curve)
    light = (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a)
    return np.clip(light @ np.linalg.inv(TO_ACES).T * EXPOSURE / LIGHT_STRENGTH, 0, 1)


@dataclass(frozen=True, kw_only=True)
class Frustum:
    """Camera whose optical axis passes through the centre of its picture.

    Attributes:
        rotation: (3, 3) float64, camera to world.
        position: (3,) float64, in world space.
        fov: Vertical field of view of the picture in radians.
        aspect: Width divided by height of the picture.
        image: (h, w, 4) uint8, photograph in screen colours, padded with transparent pixels so that
            the principal point is at the centre.
    """

    rotation: np.ndarray
    position: np.ndarray
    fov: float
    aspect: float
    image: np.ndarray


def frustum(capture: Capture, view: int, side: int) -> Frustum:
    """Return a camera with its photograph, exposed for the object, at most ``side`` pixels wide."""
    sensor = capture.sensors[view]
    pose = to_world(sensor) @ OPENCV
    width, height = film_size(sensor)
    x, y = principal_point(sensor)
    half = np.array([max(x, width - x), max(y, height - y)])  # of the padded picture
    screen = tone_mapped(with_bounds(capture, view), capture.masks[view])
    small = Image.fromarray(quantized(screen))
    small.thumbnail((side, side))
    scale = np.array(small.size) / (width, height)
    before = np.rint((half - (x, y)) * scale).astype(int)
    canvas = Image.new("RGBA", tuple(np.rint(2 * half * scale).astype(int).tolist()))
    canvas.paste(small, tuple(before.tolist()))
    extent = canvas.size / scale  # rounded to whole pixels
    return Frustum(
        rotation=pose[:3, :3], position=pose[:3, 3],
        fov=float(2 * np.arctan(extent[1] / 2 / focal_length(sensor))),
        aspect=float(extent[0] / extent[1]), image=np.array(canvas),
    )  # fmt: skip

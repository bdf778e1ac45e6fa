"""The object as a model for viser's page, in colours that appear as they are meant.

three.js, which renders that page, sends everything through a fit of the ACES filmic curve (S.
Hill, BakingLab, as in three.js's ``tonemapping_pars_fragment``). It is undone here, so that a
colour on the object can be compared with the colour bar beside it, or with a photograph.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from PIL import Image

from svu_mi.capture import mesh as meshes
from svu_mi.capture.picture import decoded, quantized, srgb

GAIN = 4.0  # light by which a texture is multiplied: white needs more than a texture can hold
EXPOSURE = 0.6
TO_ACES = np.array([
    [0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777],
])  # fmt: skip
FROM_ACES = np.array([
    [1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602],
])  # fmt: skip
# y = (x^2 + B x - C) / (D x^2 + E x + F)
B, C, D, E, F = 0.0245786, 0.000090537, 0.983729, 0.4329510, 0.238081


def model(mesh: Any, colors: np.ndarray) -> Any:
    """Return a mesh with a texture as a ``trimesh.Trimesh``.

    Args:
        mesh: an ``mi.Mesh`` with UVs.
        colors: (H, W, 3) screen colours in [0, 1] that it has under white light of strength
            ``GAIN``; row 0 is v = 0.
    """
    import trimesh  # takes long to import

    source = meshes.arrays(mesh)
    assert source.uvs is not None
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(material_colors(colors)), metallicFactor=0.0,
        roughnessFactor=1.0, doubleSided=True,
    )  # fmt: skip
    # trimesh turns V over when it writes glTF, whose v = 0 is the image's top row.
    uvs = meshes.flipped_v(source.uvs)
    visual = trimesh.visual.TextureVisuals(uv=uvs, material=material)
    return trimesh.Trimesh(source.positions, source.faces, visual=visual, process=False)


def material_colors(colors: np.ndarray) -> np.ndarray:
    """Return uint8 colours of a rough material that under the light appears in screen colours."""
    return quantized(srgb(before_tone_mapping(decoded(colors))))


def before_tone_mapping(linear: np.ndarray) -> np.ndarray:
    """Return the texture that appears in linear colours under light of strength ``GAIN``.

    Args:
        linear: (..., 3) wanted on the screen, in [0, 1].

    Returns:
        (..., 3) linear, in [0, 1]. The most saturated colours are out of the curve's reach; they
        come out a little paler, and white a little grey.
    """
    curve = np.clip(linear @ np.linalg.inv(FROM_ACES).T, 0, 1)
    a, b, c = 1 - D * curve, B - E * curve, -(C + F * curve)
    light = (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a)
    return np.clip(light @ np.linalg.inv(TO_ACES).T * EXPOSURE / GAIN, 0, 1)

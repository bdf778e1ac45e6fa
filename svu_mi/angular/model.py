"""The reflection model (Eq. 6) that angular statistics compare photographs with.

For a roughness level k, radiance is linear in Kd and R0:

    r = Kd e_k + R0 p_k + q_k

with the diffuse shading e, and a specular lobe of visible light s split into a part p that is
proportional to R0, and a part q that Fresnel adds whatever R0 is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.brdf.diffuse import diffuse_shading
from svu_mi.brdf.lobes import (
    ALBEDO_NODES,
    dielectric_albedo,
    dominance,
    profile_of,
    reflected_at_view,
    split_sum,
)
from svu_mi.brdf.principled import alpha_from_roughness
from svu_mi.frequency import harmonics
from svu_mi.interop import owned
from svu_mi.options import AngularPreset
from svu_mi.radiance import Hemisphere, Levels, Lighting, filter_light, hemisphere, light_cells
from svu_mi.radiance.observe import Surface

DEGREE = 4  # of the harmonics that occlude wide lobes
CELL_BLUR = 0.45  # of the mean distance between cells, which blur what is known of visibility
SHARP = 6.0  # a lobe of width alpha trusts the mirror ray by exp(-(6 alpha)^2)


@dataclass(frozen=True)
class Reflection:
    """Everything the model needs to know of a capture's light and of a set of texels.

    Attributes:
        switches: which model.
        roughness: (R,) of the levels.
        levels: light filtered for each.
        albedo: (R * ALBEDO_NODES * 2,) Float, the split-sum pair.
        dielectric: (R * ALBEDO_NODES,) Float, the albedo with exact dielectric reflectance.
        arriving: light that reaches each texel.
        channels: 3, or 1 for grey.
    """

    switches: AngularPreset
    roughness: np.ndarray
    levels: Levels
    albedo: Any
    dielectric: Any
    arriving: Hemisphere
    channels: int

    @property
    def cell_blur(self) -> float:
        """Width of a cell of the light [rad]."""
        return float(CELL_BLUR * np.sqrt(4 * np.pi / self.switches.rays))

    @property
    def alpha(self) -> np.ndarray:
        """(R,) lobe widths."""
        return alpha_from_roughness(self.roughness)


def reflection(
    scene: Any,
    surface: Surface,
    lighting: Lighting,
    roughness: np.ndarray,
    switches: AngularPreset,
    channels: int | None = None,
) -> Reflection:
    """Filter the light and trace the texels' hemispheres.

    Args:
        scene: what occludes.
        surface: the texels.
        lighting: the capture's light.
        roughness: (R,) levels.
        switches: the model.
        channels: of colour, 1 or 3; the preset's own by default.
    """
    channels = channels or switches.colors
    alpha = alpha_from_roughness(roughness)
    # Rays first: Dr.Jit traces them while NumPy filters the light.
    arriving = reaching(scene, surface, lighting, switches, channels)
    return Reflection(
        switches=switches,
        roughness=roughness,
        levels=filter_light(lighting, alpha, profile_of(switches.lobe), grey=channels == 1),
        albedo=owned(mi.Float, split_sum(alpha).ravel()),
        dielectric=owned(mi.Float, dielectric_albedo(alpha).ravel()),
        arriving=arriving,
        channels=channels,
    )


def reaching(
    scene: Any, surface: Surface, lighting: Lighting, switches: AngularPreset, channels: int
) -> Hemisphere:
    """Trace which light reaches texels: what a ``Reflection`` knows of them, and all it does."""
    return hemisphere(
        scene,
        surface,
        lighting,
        light_cells(lighting.environment, switches.rays),
        channels=channels,
        occluded=switches.occluded_diffuse,
        lobes=DEGREE if switches.occluded_specular else None,
    )


@dataclass(frozen=True)
class Terms:
    """e, p and q of one sample, per level and channel: Floats.

    And what a dielectric reflects: F0 p + q where Fresnel's term is approximate, or better.
    """

    diffuse: list[list[Any]]
    scaled: list[list[Any]]
    added: list[list[Any]]
    dielectric: list[list[Any]]


def terms(model: Reflection, normal: Any, direction: Any, cosine: Any, mirror_free: Any) -> Terms:
    """Evaluate the model for one view of every texel.

    Args:
        model: the light and the texels.
        normal: Normal3f, shading normals.
        direction: unit Vector3f to the camera.
        cosine: Float, between the two, positive.
        mirror_free: Bool, nothing stands in the mirror direction.
    """
    shading = [
        diffuse_shading(model.switches.diffuse, moments, direction, cosine)
        for moments in model.arriving.diffuse
    ]
    mirror = 2 * cosine * normal - direction
    lost = lost_light(model.arriving, mirror)
    diffuse, scaled, added, dielectric = [], [], [], []
    for k, roughness in enumerate(model.roughness.tolist()):
        alpha = float(model.alpha[k])
        lobe = _lobe_light(model, k, alpha, normal, mirror)
        if lost is not None:
            visible = visible_part(lost, alpha, model.cell_blur, mirror_free)
            lobe = [visible * value for value in lobe]
        A, B, D = _fresnel(model, k, alpha, cosine)
        diffuse.append([a + roughness * b for a, b in shading])
        scaled.append([value * A for value in lobe])
        added.append([value * B for value in lobe])
        dielectric.append([value * D for value in lobe])
    return Terms(diffuse, scaled, added, dielectric)


def _lobe_light(
    model: Reflection, level: int, alpha: float, normal: Any, mirror: Any
) -> list[Any]:
    """Filtered light where the lobe of one level points."""
    direction = mirror
    if model.switches.off_specular:
        part = float(dominance(np.array(alpha)))
        direction = dr.normalize(dr.lerp(mi.Vector3f(normal), mirror, part))
    return model.levels.radiance(level, direction)


def _fresnel(model: Reflection, level: int, alpha: float, cosine: Any) -> tuple[Any, Any, Any]:
    """(A, B, D): the lobe reflects R0 A + B, and that of a dielectric D."""
    rule = model.switches.fresnel
    if rule == "split_sum":
        place = dr.clip(cosine * ALBEDO_NODES - 0.5, 0, ALBEDO_NODES - 1.001)
        first = mi.UInt32(place)
        part = place - first
        index = first + level * ALBEDO_NODES
        here, after = (dr.gather(mi.Vector2f, model.albedo, index + step) for step in (0, 1))
        pair = dr.lerp(here, after, part)
        low, high = (dr.gather(mi.Float, model.dielectric, index + step) for step in (0, 1))
        return pair.x, pair.y, dr.lerp(low, high, part)
    return reflected_at_view(rule, cosine, alpha)


def lost_light(arriving: Hemisphere, mirror: Any) -> tuple[list[Any], list[Any]] | None:
    """Visible and all light around the mirror direction, by degree; None if not traced."""
    if not arriving.visible:
        return None
    basis = harmonics.basis(mirror, DEGREE)
    sums: tuple[list[Any], list[Any]] = ([], [])
    for result, coefficients in zip(sums, (arriving.visible, arriving.unoccluded), strict=True):
        for l in range(DEGREE + 1):
            span = slice(l * l, (l + 1) ** 2)
            pairs = zip(coefficients[span], basis[span], strict=True)
            result.append(sum(c * Y for c, Y in pairs))
    return sums


def visible_part(
    lost: tuple[list[Any], list[Any]], alpha: Any, cell: float, mirror_free: Any
) -> Any:
    """Part of a lobe's light that is visible, in [0, 1].

    Wide lobes see what the cells saw; narrow ones what one ray in the mirror direction did.

    Args:
        lost: see ``lost_light``.
        alpha: width of the lobe, a number or a Float.
        cell: width of a cell of the light [rad].
        mirror_free: Bool, nothing stands in the mirror direction.
    """
    exp = dr.exp if dr.is_array_v(alpha) else math.exp
    # What the lobe leaves of a degree, and a cell: exp(-l (l + 1) w^2 / 2).
    factors = [
        exp(-((alpha * l) ** 2) - l * (l + 1) * cell**2 / 2) for l in range(DEGREE + 1)
    ]
    free, whole = (sum(f * v for f, v in zip(factors, values, strict=True)) for values in lost)
    # Where hardly any light comes from, it does not matter which part of it is seen.
    wide = dr.select(whole > 1e-3 * dr.abs(lost[1][0]), dr.clip(free / whole, 0, 1), 1)
    sharp = exp(-((SHARP * alpha) ** 2))
    return sharp * dr.select(mirror_free, mi.Float(1), 0) + (1 - sharp) * wide

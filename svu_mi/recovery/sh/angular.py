"""Mean absolute error between photographs and the reflection model, over all samples.

The loss of the paper's recovery in the angular domain (Sec. 5.1): every step goes through all
views of all texels. Loss and derivatives are summed in the same pass, in one kernel; derivatives
then reach the textures by one gather per texel, so that no addition is atomic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.angular import Reflection, reflection
from svu_mi.angular.continuous import Continuous, Shading, shade
from svu_mi.angular.model import lost_light, visible_part
from svu_mi.errors import CaptureError, OptionError
from svu_mi.interop import owned
from svu_mi.options import AngularPreset
from svu_mi.radiance import Lighting, Surface, Survey, Views
from svu_mi.radiance.bits import Bits
from svu_mi.radiance.hemisphere import as_channels, mirror_free
from svu_mi.radiance.observe import Observation
from svu_mi.recovery.sh.gradient import Values, carry, look_up
from svu_mi.surface import Texels

FEWEST_LEVELS = 2


@dataclass(frozen=True, kw_only=True)
class AngularObjective:
    """sum |b - r| / (n C unit), over the n visible (texel, view) samples and C channels.

    Attributes:
        views: the packed capture, in C = 3 channels.
        surface: the S texels that some view sees.
        found: who sees whom.
        model: the light and the lobes.
        arriving: ``Reflection`` of the same texels, for what reaches each of them.
        place: (S,) UInt32, where in a texture each of them is.
        free: of N views and S texels: whether nothing stands in the mirror direction of the
            view ``found.order[i]``; None if not traced.
        factor: opaque Float, 1 / (n C unit).
    """

    views: Views
    surface: Surface
    found: Survey
    model: Continuous
    arriving: Reflection
    place: Any
    free: Bits | None
    factor: Any

    def __call__(self, textures: Mapping[str, Any], step: int = 0) -> Any:
        """Return the loss as a Float that derivatives reach the textures through.

        Args:
            textures: base_color (H, W, 3), roughness and metallic (H, W, 1), TensorXf.
            step: not used: every step looks at everything.
        """
        del step
        values = look_up(textures, self.place)
        with dr.suspend_grad():
            loss, *slopes = self._sums(Values(*(dr.detach(v) for v in values)))
            dr.eval(loss, slopes)
        return carry(loss, slopes, values, self.factor)

    def _sums(self, values: Values) -> tuple[Any, ...]:
        """Loss and its derivatives for R, G, B, roughness and metallic, summed per texel."""
        normal = mi.Vector3f(self.surface.normal)

        def consume(seen: Observation, slot: Any, *sums: Any) -> tuple[Any, ...]:
            def add(values: Values, *sums: Any) -> tuple[Any, ...]:
                return self._add(seen, slot, normal, values, sums)

            asked = self.found.asked(seen.seen)
            found = dr.if_stmt(
                args=(values, *sums), cond=asked, true_fn=add, false_fn=lambda _, *s: s
            )
            return tuple(found)

        zeros = tuple(dr.zeros(mi.Float, self.surface.count) for _ in range(6))
        return self.found.over_views(self.views, self.surface, consume, zeros)

    def _add(
        self, seen: Observation, slot: Any, normal: Any, values: Values, sums: tuple[Any, ...]
    ) -> tuple[Any, ...]:
        """Add one sample of every texel to the sums."""
        base_color, metallic = [values.red, values.green, values.blue], values.metallic
        with dr.resume_grad():
            roughness = mi.Float(values.roughness)
            dr.enable_grad(roughness)
            shading = self._shade(seen, slot, normal, roughness)
            modelled = shading.radiance(base_color, metallic)
            dr.forward_from(roughness)
            rise = [dr.grad(value) for value in modelled]
        shading, modelled = dr.detach(shading), dr.detach(modelled)
        observed = as_channels(seen.radiance, len(base_color))
        away = [r - b for r, b in zip(modelled, observed, strict=True)]
        sign = [dr.select(seen.seen, dr.sign(difference), 0) for difference in away]
        added = [sum(dr.select(seen.seen, dr.abs(difference), 0) for difference in away)]
        to_metallic = mi.Float(0)
        for k, color in enumerate(base_color):
            e, p, q, d = (part[k % len(part)] for part in shading.parts)
            added.append(sign[k] * dr.lerp(e, p, metallic))
            to_metallic += sign[k] * (color * (p - e) + q - d)
        to_roughness = sum(s * slope for s, slope in zip(sign, rise, strict=True))
        added += [to_roughness, to_metallic]
        return tuple(old + new for old, new in zip(sums, added, strict=True))

    def _shade(self, seen: Observation, slot: Any, normal: Any, roughness: Any) -> Shading:
        visible = None
        if self.free is not None:
            visible = partial(self._visible, self.free.test(slot, self.surface.lane))
        moments = self.arriving.arriving.diffuse
        return shade(self.model, roughness, normal, seen.direction, moments, visible=visible)

    def _visible(self, free: Any, mirror: Any, alpha: Any) -> Any:
        lost = lost_light(self.arriving.arriving, mirror)
        assert lost is not None
        return visible_part(lost, alpha, self.arriving.cell_blur, free)


def angular_objective(
    views: Views,
    texels: Texels,
    found: Survey,
    lighting: Lighting,
    switches: AngularPreset,
    levels: int = 16,
) -> AngularObjective:
    """Prepare the loss: filter the light, and trace what reaches every texel.

    Args:
        views: the packed capture, in three channels.
        texels: all T texels.
        found: who sees whom.
        lighting: the capture's light.
        switches: the reflection model; ``paper`` for the paper's.
        levels: of roughness that the light is filtered for.

    Raises:
        OptionError: fewer than two levels, or photographs packed in grey.
        CaptureError: no texel is seen, or all photographs are black where one is.
    """
    if levels < FEWEST_LEVELS:
        raise OptionError(f"Recovery needs {FEWEST_LEVELS} or more roughness levels, got {levels}.")
    if views.channels != 3:
        raise OptionError("Recovery needs photographs in colour; pack them in 3 channels.")
    coverage = found.coverage.numpy()
    if not found.scale > 0:
        raise CaptureError("No texel is seen with any radiance; check poses, masks and exposures.")
    selection = owned(mi.UInt32, np.flatnonzero(coverage).astype(np.uint32))
    surface = Surface.of(texels, selection)
    arriving = reflection(
        views.scene, surface, lighting, np.linspace(0, 1, levels), switches,
        channels=1 if lighting.environment.grey else 3,
    )  # fmt: skip
    samples = 3.0 * int(coverage.sum(dtype=np.int64))
    return AngularObjective(
        views=views,
        surface=surface,
        found=found,
        model=Continuous.of(arriving),
        arriving=arriving,
        place=dr.gather(mi.UInt32, texels.index, selection),
        free=_mirrors(views, surface, found) if switches.occluded_specular else None,
        factor=dr.opaque(mi.Float, 1 / (samples * found.scale)),
    )


def _mirrors(views: Views, surface: Surface, found: Survey) -> Bits:
    """Trace the mirror direction of every sample once; returns the bits of ``free``."""
    bits, lane = Bits.clear(int(found.count[0]), surface.count), surface.lane

    def trace(seen: Observation, slot: Any, none: Any) -> tuple[Any]:
        free = mirror_free(views.scene, surface, seen, found.asked(seen.seen))
        bits.set(slot, lane, free)
        return (none,)

    # A value per lane, or the loop would have a single lane.
    found.over_views(views, surface, trace, (dr.zeros(mi.UInt32, surface.count),))
    dr.eval(bits)
    return bits

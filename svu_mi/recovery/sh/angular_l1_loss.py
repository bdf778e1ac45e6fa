"""Angular loss of the paper: mean absolute error of the SH model (Eq. 6).

Each step convolves the light of every texel with its lobe and loops over all views (Sec. 5.1).
Loss and derivatives are summed in one pass. One gather per texel then propagates the derivatives
to the textures, without atomic additions.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.errors import OptionError
from svu_mi.frequency.fit_samples import MirroredLight
from svu_mi.frequency.sh_lobes import ConvolvedLight
from svu_mi.geometry.packed_views import Views
from svu_mi.geometry.pixel_footprint import as_channels
from svu_mi.geometry.sample_view import TexelLanes, ViewSample
from svu_mi.geometry.visibility import Visibility
from svu_mi.light.band_limited import moment_map
from svu_mi.parameters import MIXED
from svu_mi.posterior.observations import Observed
from svu_mi.presets import AngularPreset
from svu_mi.recovery.regularizers.known_gradient import sign
from svu_mi.recovery.sh.quadratic_error import sum_over_texels
from svu_mi.reflection.lobes import view_albedo
from svu_mi.reflection.mix_columns import Parts, combine_parts, diffuse_shading, dot, mixed_radiance
from svu_mi.reflection.principled import alpha_from_roughness, columns, mixture, mixture_derivative
from svu_mi.statistics.gather_statistics import GRAZING, Values, mixing_values


@dataclass(frozen=True, kw_only=True)
class AngularObjective:
    """Mean absolute error sum |b - r| / (n C u) of n visible samples (texel, view).

    u is the mean radiance of the capture (``Visibility.scale``).

    Attributes:
        views: Packed photographs with C = 3 channels.
        surface: The S texels visible in at least one view.
        visibility: Texel-view visibility.
        switches: Options of the reflection model.
        light: Light that the texels reflect into their views, for the SH fit (Eq. 12).
        moments: Moments of the diffuse irradiance, 8 Floats (S,) per channel.
        place: (S,) UInt32, flat index of each texel in a texture.
        factor: Opaque Float, 1 / (n C u).
    """

    views: Views
    surface: TexelLanes
    visibility: Visibility
    switches: AngularPreset
    light: MirroredLight
    moments: list[list[Any]]
    place: Any
    factor: Any

    def __call__(self, textures: Mapping[str, Any], _: int = 0) -> Any:
        """Return the loss, a Float that is differentiable in the textures."""
        return sum_over_texels(self._sums, textures, self.place) * self.factor

    def _sums(self, values: Values) -> tuple[Any, Values]:
        """Return the loss and its derivatives in all parameters, summed per texel."""
        lobes = ConvolvedLight.of(self.light, values["roughness"][0])

        def consume(seen: ViewSample, _: Any, *sums: Any) -> tuple[Any, ...]:
            def add(values: Values, loss: Any, slopes: Values) -> tuple[Any, Values]:
                more, added = self._sample(seen, lobes, values)
                return loss + more, {
                    name: [old + new for old, new in zip(slopes[name], added[name], strict=True)]
                    for name in slopes
                }

            needed = self.visibility.needs_work(seen.seen)
            added = dr.if_stmt(
                args=(values, *sums), cond=needed, true_fn=add, false_fn=lambda _, *s: s
            )
            return tuple(added)

        def zero() -> Any:
            return dr.zeros(mi.Float, self.surface.count)

        none = {name: [zero() for _ in of_name] for name, of_name in values.items()}
        loss, slopes = self.visibility.over_views(self.views, self.surface, consume, (zero(), none))
        return loss, slopes

    def _sample(
        self, seen: ViewSample, lobes: ConvolvedLight, values: Values
    ) -> tuple[Any, Values]:
        """Return loss and derivatives of one sample per texel."""
        base_color, mixed = values["base_color"], mixing_values(values)
        with dr.resume_grad():
            roughness = mi.Float(values["roughness"][0])
            dr.enable_grad(roughness)
            parts = self._shade(seen, lobes, roughness)
            modelled = mixed_radiance(parts, base_color, mixed)
            dr.forward_from(roughness)
            rise = [dr.grad(value) for value in modelled]
        parts, modelled = dr.detach(parts), dr.detach(modelled)
        observed = as_channels(seen.radiance, len(base_color))
        away = [r - b for r, b in zip(modelled, observed, strict=True)]
        side = [dr.select(seen.seen, sign(difference), 0) for difference in away]
        loss = sum(dr.select(seen.seen, dr.abs(difference), 0) for difference in away)
        added = {name: [mi.Float(0)] for name in MIXED} | {
            "base_color": [], "roughness": [sum(s * x for s, x in zip(side, rise, strict=True))],
        }  # fmt: skip
        how, turns = mixture(*mixed), [mixture_derivative(mixed, k) for k in range(len(mixed))]
        for k, color in enumerate(base_color):
            x = columns(*parts[k % len(parts)])
            added["base_color"].append(side[k] * dot(how.slope, x))
            for name, turn in zip(MIXED, turns, strict=True):
                added[name][0] += side[k] * dot(turn.at(color), x)
        return loss, added

    def _shade(self, seen: ViewSample, lobes: ConvolvedLight, roughness: Any) -> list[Parts]:
        """Evaluate the columns of Eq. 6 towards the camera, differentiable in roughness."""
        cosine = dr.maximum(seen.cosine, GRAZING)
        moved = roughness - dr.detach(roughness)  # value 0, derivative 1
        mirrored = lobes.evaluate(seen.direction)
        light = [dr.fma(slope, moved, value) for value, slope in mirrored]
        alpha = alpha_from_roughness(roughness)
        diffuse = [
            diffuse_shading(self.switches.diffuse, each, seen.direction, cosine)
            for each in self.moments
        ]
        reflected = view_albedo(self.switches.fresnel, cosine, alpha)
        return combine_parts(diffuse, roughness, reflected, light)


def angular_objective(observed: Observed, switches: AngularPreset) -> AngularObjective:
    """Return the loss of a capture; fits the light of every visible texel.

    Raises:
        OptionError: The preset has no fit of light.
    """
    if switches.fit is None:
        raise OptionError(
            "The angular loss needs light that is fitted to every texel, but preset "
            f"{switches.name!r} has no fit; use preset('paper', method='angular')."
        )
    visibility, texels = observed.visibility, observed.texels
    channels = 1 if observed.lighting.environment.grey else 3
    seen = np.flatnonzero(observed.coverage)
    light = MirroredLight(observed, switches.fit, channels, seen)
    selection = to_drjit(mi.UInt32, seen.astype(np.uint32))
    surface = TexelLanes.of(texels, selection)
    diffuse = moment_map(observed.lighting.environment, channels)
    samples = 3.0 * int(observed.coverage.sum(dtype=np.int64))
    return AngularObjective(
        views=observed.views,
        surface=surface,
        visibility=visibility,
        switches=switches,
        light=light,
        moments=diffuse.in_world(surface.normal),
        place=dr.gather(mi.UInt32, texels.index, selection),
        factor=dr.opaque(mi.Float, 1 / (samples * visibility.scale)),
    )

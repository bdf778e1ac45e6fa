"""Specular lobes from spherical harmonics of each texel's mirrored light (Eq. 6).

    B(omega_o) = Kd / pi E + F(theta_o) G1(theta_o; alpha) [S_alpha * G1(theta_i; alpha) L](omega_o)

L(omega_o) is the light from the mirror direction of omega_o. G1(theta_i) L is expanded to degree l*
for each texel (Eq. 12). The convolution with S_alpha multiplies degree l by exp(-(alpha l)^2).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.local_memory import scatter_strided
from svu_mi.frequency.fit_samples import MirroredLight
from svu_mi.presets import AngularPreset, Fresnel
from svu_mi.reflection.lobes import smith_g1, smith_g1_slope, view_albedo
from svu_mi.reflection.principled import alpha_from_roughness
from svu_mi.reflection.wide_lobes import Lobe


@dataclass(frozen=True)
class ShLobes:
    """Specular lobes of K widths from SH fits of each texel's light.

    Attributes:
        alpha: (K,) float64 widths.
        values: (K n C S,) Float, n = (l* + 1)^2: coefficients of S_alpha * G1 L, in radiance, by
            width, l*l + l + m, channel and lane; 0 where unseen.
    """

    fresnel: Fresnel
    alpha: np.ndarray
    values: Any
    light: MirroredLight

    @staticmethod
    def of(light: MirroredLight, alpha: np.ndarray, switches: AngularPreset) -> "ShLobes":
        """Fit the light and convolve it with lobes; needs 4 n C bytes per texel and width."""
        rows, count = (light.fit.degree + 1) ** 2 * light.channels, len(light.chosen)
        values = light.allocate(len(alpha) * rows)
        for level, width in enumerate(alpha.tolist()):
            square = dr.opaque(mi.Float, float(_square(light, width)))
            for lane, coefficients in light.solutions(_masking(width), 1):
                convolved = [
                    _decay(square, row) * value
                    for row, values_of in enumerate(coefficients) for value in values_of
                ]  # fmt: skip
                start = lane + dr.opaque(mi.UInt32, level * rows * count)
                stride = dr.opaque(mi.UInt32, count)
                values = scatter_strided(values, convolved, start, stride)
                dr.eval(values)
        return ShLobes(switches.fresnel, alpha, values, light)

    def reflect(self, direction: Any, cosine: Any) -> list[Lobe]:
        """Return the light reflected towards a camera by the lobe of each width."""
        light, channels = self.light, self.light.channels
        stride, rows = len(light.chosen), (light.fit.degree + 1) ** 2 * channels
        columns = [
            dr.opaque(mi.UInt32, (level * rows + c) * stride)
            for level in range(len(self.alpha)) for c in range(channels)
        ]  # fmt: skip
        radiance = _evaluate(
            self.values, direction, light.fit.degree, dr.arange(mi.UInt32, stride),
            dr.opaque(mi.UInt32, channels * stride), columns,
        )  # fmt: skip
        result = []
        for level, alpha in enumerate(self.alpha.tolist()):
            # Opaque: with a literal, Dr.Jit would compile another kernel for each grid.
            A, B, D = view_albedo(self.fresnel, cosine, dr.opaque(mi.Float, alpha))
            own = radiance[level * channels : (level + 1) * channels]
            result.append([(A * value, B * value, D * value) for value in own])
        return result


@dataclass(frozen=True)
class ConvolvedLight:
    """Light convolved with a lobe of a different width for each texel.

    Attributes:
        values: (2 n C S,) Float: values and roughness derivatives of the coefficients, by
            l*l + l + m, (value, derivative), channel and lane.
    """

    values: Any
    light: MirroredLight

    @staticmethod
    def of(light: MirroredLight, roughness: Any) -> "ConvolvedLight":
        """Fit and convolve the light, with the masking of each texel's roughness."""
        values = light.allocate(2 * (light.fit.degree + 1) ** 2 * light.channels)
        stride = dr.opaque(mi.UInt32, len(light.chosen))

        def masking(cosine: Any, texel: Any) -> list[Any]:
            lane = dr.gather(mi.UInt32, light.lane, texel)
            alpha, slope = _widths(dr.gather(mi.Float, roughness, lane))
            return [smith_g1(cosine, alpha), slope * smith_g1_slope(cosine, alpha)]

        for lane, coefficients in light.solutions(masking, 2):
            alpha, slope = _widths(dr.gather(mi.Float, roughness, lane))
            square = _square(light, alpha)
            rise = dr.select(square > 0, 2 * alpha * slope, 0)
            convolved = []
            for row, both in enumerate(coefficients):
                decay, l = _decay(square, row), int(row**0.5)
                value, change = both[: light.channels], both[light.channels :]
                convolved += [decay * c for c in value]
                convolved += [
                    decay * (d - rise * (l * l) * c) for c, d in zip(value, change, strict=True)
                ]
            values = scatter_strided(values, convolved, lane, stride)
            dr.eval(values)
        return ConvolvedLight(values, light)

    def evaluate(self, direction: Any) -> list[tuple[Any, Any]]:
        """Return S_alpha * G1 L in a direction and its roughness derivative, per channel."""
        channels, count = self.light.channels, len(self.light.chosen)
        stride = dr.opaque(mi.UInt32, count)
        values = _evaluate(
            self.values, direction, self.light.fit.degree, dr.arange(mi.UInt32, count),
            2 * channels * stride, [k * stride for k in range(2 * channels)],
        )  # fmt: skip
        return list(zip(values[:channels], values[channels:], strict=True))


def _masking(alpha: float) -> Callable[[Any, Any], list[Any]]:
    """Return the masking function G1(theta_i; alpha), with an opaque alpha."""
    width = dr.opaque(mi.Float, alpha)
    return lambda cosine, _: [smith_g1(cosine, width)]


def _widths(roughness: Any) -> tuple[Any, Any]:
    """Return alpha and its roughness derivative."""
    alpha = alpha_from_roughness(roughness)
    return alpha, dr.select(roughness * roughness < alpha, 0, 2 * roughness)


def _square(light: MirroredLight, alpha: Any) -> Any:
    """Return alpha^2, minus the light's band limit alpha'^2 if ``undo_prefilter`` is set."""
    undone = light.observed.lighting.prefilter**2 if light.fit.undo_prefilter else 0.0
    maximum = dr.maximum if dr.is_array_v(alpha) else np.maximum
    return maximum(alpha * alpha - undone, 0)


def _decay(square: Any, row: int) -> Any:
    """Return exp(-(alpha l)^2) of coefficient ``row`` = l*l + l + m."""
    l = int(row**0.5)
    return dr.exp(-square * (l * l))


@dr.syntax
def _evaluate(
    values: Any, direction: Any, degree: int, place: Any, advance: Any, columns: list[Any]
) -> list[Any]:
    """Return the sum over (l, m) of Y_lm(direction) times coefficients, for each column."""
    number = (degree + 1) ** 2
    basis = dr.alloc_local(mi.Float, number)
    for k, y in enumerate(dr.sh_eval(mi.Vector3f(direction), degree)):
        basis[k] = y
    sums = [0 * direction[0] for _ in columns]
    index = mi.UInt32(0)
    while index < number:
        y = basis[index]
        sums = _add(sums, y, values, place, columns)
        place = place + advance
        index += 1
    return sums


def _add(sums: list[Any], factor: Any, values: Any, place: Any, columns: list[Any]) -> list[Any]:
    return [
        dr.fma(factor, dr.gather(mi.Float, values, place + column), total)
        for column, total in zip(columns, sums, strict=True)
    ]

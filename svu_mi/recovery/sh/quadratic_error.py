"""Mean squared error as a function of the parameters, from sufficient statistics.

Factors of a texel are interpolated between roughness levels by Catmull-Rom splines [Catmull and
Rom 1974], which have continuous derivatives. The gradient is computed per texel and propagated to
textures without atomic operations (``known_gradient``).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.parameters import CHANNELS, MIXED
from svu_mi.recovery.regularizers.known_gradient import with_known_gradient
from svu_mi.reflection.mix_columns import dot
from svu_mi.reflection.principled import mixture, mixture_derivative
from svu_mi.reflection.roughness_levels import catmull_rom, continued, level_place, level_slope
from svu_mi.statistics.cholesky_factors import Factors, apply_factor
from svu_mi.statistics.gather_statistics import Values, mixing_values


def energy(factors: Factors, values: Values) -> tuple[Any, Values]:
    """Return the squared error of S texels, averaged over views and channels.

    Args:
        factors: Statistics of the texels, as triangular factors.
        values: Parameters of the texels, in [0, 1].

    Returns:
        Float (S,) in squared radiance, and its derivatives in all parameters.
    """
    near = _interpolate(factors, values["roughness"][0])
    mixed, colors, error = mixing_values(values), values["base_color"], mi.Float(0)
    mix, turns = mixture(*mixed), [mixture_derivative(mixed, k) for k in range(len(mixed))]
    by = {name: [mi.Float(0) for _ in of_name] for name, of_name in values.items()}
    for channel, c in enumerate(colors):
        # If photographs and light are grey, one channel of statistics serves all.
        U, change = near[channel % factors.channels]
        x = mix.at(c)
        rest = apply_factor(U, x)
        error += dot(rest, rest)
        by["base_color"][channel] = 2 * dot(rest, apply_factor(U, mix.slope))
        by["roughness"][0] += 2 * dot(rest, apply_factor(change, x))
        for name, turn in zip(MIXED, turns, strict=True):
            by[name][0] += 2 * dot(rest, apply_factor(U, turn.at(c)))
    scale = 1 / len(colors)
    return scale * error, {name: [scale * x for x in of_name] for name, of_name in by.items()}


def information(factors: Factors, values: Values) -> list[list[Any]]:
    """Return the Gauss-Newton matrix J^T J of S texels.

    J is the Jacobian of the residuals. The matrix approximates half the Hessian of ``energy``.

    Returns:
        Symmetric matrix of Floats (S,) in squared radiance; rows and columns in the order of
        ``values``.
    """
    near = _interpolate(factors, values["roughness"][0])
    mixed, colors = mixing_values(values), values["base_color"]
    mix, turns = mixture(*mixed), [mixture_derivative(mixed, k) for k in range(len(mixed))]
    places = {key: place for place, key in enumerate(
        (name, k) for name, of_name in values.items() for k in range(len(of_name)))}  # fmt: skip
    matrix = [[dr.zeros(mi.Float, factors.count) for _ in places] for _ in places]
    for channel, c in enumerate(colors):
        U, change = near[channel % factors.channels]
        by = {
            ("base_color", channel): apply_factor(U, mix.slope),
            ("roughness", 0): apply_factor(change, mix.at(c)),
            **{
                (name, 0): apply_factor(U, turn.at(c))
                for name, turn in zip(MIXED, turns, strict=True)
            },
        }
        for one, first in by.items():
            for other, second in by.items():
                i, j = places[one], places[other]
                matrix[i][j] += dot(first, second) / len(colors)
    return matrix


def _interpolate(factors: Factors, roughness: Any) -> list[tuple[list[Any], list[Any]]]:
    """Return U and dU / d roughness of every channel, interpolated from four levels."""
    last = dr.opaque(mi.Float, factors.levels - 1)
    roughness = dr.clip(roughness, 0, 1)
    place, slope = level_place(roughness, last), level_slope(roughness, last)
    first = dr.maximum(dr.minimum(dr.floor(place), last - 1), 0)  # last may be 0
    t = place - first
    slopes = [
        0.5 * slope * (-1 + t * (4 - 3 * t)),
        0.5 * slope * t * (-10 + 9 * t),
        0.5 * slope * (1 + t * (8 - 9 * t)),
        0.5 * slope * t * (3 * t - 2),
    ]
    levels = [mi.UInt32(dr.clip(first + step, 0, last)) for step in (-1, 0, 1, 2)]
    weights, slopes = (continued(x, first, last) for x in (catmull_rom(t), slopes))
    reader = factors.reader()
    near = [reader.factor(level) for level in levels]
    return [
        (_summed(weights, of_levels), _summed(slopes, of_levels))
        for of_levels in zip(*near, strict=True)
    ]


def _summed(weights: list[Any], factors: Sequence[list[Any]]) -> list[Any]:
    """Return the weighted sum of factors, entry by entry."""
    total = [mi.Float(0)] * len(factors[0])
    for weight, factor in zip(weights, factors, strict=True):
        total = [dr.fma(weight, x, old) for x, old in zip(factor, total, strict=True)]
    return total


def look_up(textures: Mapping[str, Any], place: Any) -> Values:
    """Gather the parameters of texels from textures, differentiably.

    Args:
        textures: (H, W, C) TensorXf by name.
        place: (S,) UInt32, flat row-major indices without duplicates, so that derivatives are
            added without atomic operations.
    """

    def take(name: str, index: Any) -> Any:
        flat = textures[name].array
        return dr.gather(mi.Float, flat, index, mode=dr.ReduceMode.NoConflicts)

    return {name: [take(name, n * place + k) for k in range(n)] for name, n in CHANNELS.items()}


def sum_over_texels(
    loss_of: Callable[[Values], tuple[Any, Values]], textures: Mapping[str, Any], place: Any
) -> Any:
    """Return the sum of the losses of texels, a Float that is differentiable in the textures.

    ``loss_of`` returns the loss of each texel, and its derivatives in all parameters.
    """
    flat, gradients = [textures[name].array for name in CHANNELS], []
    with dr.suspend_grad():
        loss, slopes = loss_of(look_up(textures, place))
        dr.eval(loss, slopes)  # once, for both value and gradient
        for (name, count), values in zip(CHANNELS.items(), flat, strict=True):
            gradient = dr.zeros(mi.Float, dr.width(values))
            for k, slope in enumerate(slopes[name]):
                # Adding, as derivatives of a gather do, takes five times as long.
                dr.scatter(gradient, slope, count * place + k, mode=dr.ReduceMode.NoConflicts)
            gradients.append(gradient)
    return with_known_gradient(dr.sum(loss), gradients, flat)

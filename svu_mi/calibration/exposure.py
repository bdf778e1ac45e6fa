"""Exposure gains of photographs: estimated under a known light, and divided out.

A gain g multiplies a channel of one photograph: b = g r. Log gains are unknowns of the normal
equations (``gauss_newton``), alone or together with the light. Their mean is part of the light.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from svu_mi.calibration.light.gauss_newton import NormalEquations, normal_equations
from svu_mi.calibration.light.light_estimate import NINETY, FoundGains
from svu_mi.calibration.light.light_options import LightOptions
from svu_mi.calibration.light.light_samples import TexelSamples
from svu_mi.calibration.light.light_transport import (
    HEAT,
    Columns,
    SampleMoments,
    Transport,
    annealed,
    columns_of,
)
from svu_mi.calibration.light.light_uncertainty import scale_of
from svu_mi.capture.capture import Capture, LightUncertainty
from svu_mi.capture.pixel_buffer import PixelBuffer
from svu_mi.capture.scene import require_light
from svu_mi.core.progress import Progress
from svu_mi.errors import CaptureError
from svu_mi.geometry.texels import Texels
from svu_mi.light.light_tree import cell_radiance
from svu_mi.parameters import MIXED
from svu_mi.posterior.estimate import Estimate, observations_of
from svu_mi.posterior.observations import Observed
from svu_mi.presets import AngularPreset
from svu_mi.presets import preset as find_preset

CELLS, ROUNDS, FASTER = 1024, 6, 0.4  # decay of the overdispersion: the light is known
SELF_MIRRORED = 0.15  # error of log gains of metal, in which the object is mirrored
UNITS = 8  # factors of up to 4.5 that correct the unit of the light
FAR = np.log(2)  # larger log gains are initialized with a rough estimate instead of 0
FEWEST = 4  # photographs needed to flag outliers
ODD_GAIN = np.log(2.5)  # log gain of an outlier, relative to the median photograph
ODD_NOISE = 1.7  # residual of an outlier, relative to the median photograph
SPREADS = 3.0  # minimum deviation of an outlier in standard deviations over photographs


def estimate_gains(
    source: Capture | Observed | Estimate,
    texels: Texels | None = None,
    options: LightOptions | None = None,
    progress: Progress | None = None,
) -> FoundGains:
    """Estimate the exposure gains of photographs under the light of the capture.

    Args:
        source: Photographs and their light.
        texels: Texels of the object; a subset is used (default: the texels of ``source``).
        options: Options; only ``texels``, the size of the subset, is used.
        progress: Display of the progress.

    Returns:
        Gains of the used photographs, in order.

    Raises:
        SceneError: The light is missing or unreadable.
        OptionError: ``texels`` is missing, or differs from the texels of ``source``.
        CaptureError: No texel is seen in enough photographs, or all photographs are black.

    Example:
        >>> gains = svu.estimate_gains(capture, texels, svu.LightOptions(texels=100))
        >>> gains.factor.shape
        (12, 3)
    """
    options, progress = options or LightOptions(), progress or Progress()
    switches: AngularPreset = find_preset("default", method="angular", bare_metals=0.0)
    observed = observations_of(source, texels, progress)
    require_light(observed.capture)
    with progress.stage("Choosing texels"):
        samples = TexelSamples.of(observed, switches, options.texels, options.known)
    with progress.stage("Estimating gains", ROUNDS) as stage:
        light = cell_radiance(observed.lighting.environment, CELLS)
        everything, gains = Transport.of(samples, CELLS), starting_gains(samples)
        light, columns = _in_unit(light, everything, switches)
        heat = HEAT
        for done in range(ROUNDS):
            now, transport = annealed(switches, heat), without_gains(everything, gains)
            posterior = SampleMoments.of(transport.samples, columns).posterior(now)
            tau = now.overdispersion
            system = normal_equations(transport, light, posterior, tau, gains=gains.logarithm)
            noise = posterior.kernel.noise if heat == 1 else None
            gains, _ = step_gains(gains, samples, system, system.step(), noise)
            heat = max(heat * FASTER, 1.0)
            stage.update(done + 1, ROUNDS)
    metal = sum(float(np.mean(posterior.mean(name).numpy())) for name in MIXED)
    return replace(gains, sd=np.hypot(_standard_deviations(system.matrix), SELF_MIRRORED * metal))


def _standard_deviations(precision: np.ndarray) -> np.ndarray:
    """Return those (V,) of channel means of log gains relative to their mean over V views."""
    views = len(precision) // 3
    covariance = np.linalg.inv(precision).reshape(3, views, 3, views).mean(axis=(0, 2))
    variance = np.diag(covariance) - 2 * covariance.mean(axis=0) + covariance.mean()
    return np.asarray(np.sqrt(np.maximum(variance, 0)))


def _in_unit(
    light: np.ndarray, transport: Transport, switches: AngularPreset
) -> tuple[np.ndarray, Columns]:
    """Return the light (N, 3) in the unit of the photographs if they differ, and its columns."""
    columns = columns_of(transport, light, switches)
    for _ in range(UNITS):
        level = scale_of(transport.samples, columns, switches)
        if (np.abs(level.best) <= NINETY * level.sd).all():
            break
        light = light * np.exp(level.best)
        columns = columns_of(transport, light, switches)
    return light, columns


def with_common_gain(
    capture: Capture, texels: Texels, options: LightOptions, progress: Progress
) -> tuple[Capture, np.ndarray, np.ndarray]:
    """Divide photographs by their common brightness relative to the light of the capture.

    Returns:
        The capture, whose light keeps the uncertainty of this factor, and the ends (3,) of its 90 %
        intervals per channel.
    """
    observed = observations_of(capture, texels, progress)
    switches: AngularPreset = find_preset("default", method="angular", bare_metals=0.0)
    with progress.stage("Comparing photographs with the light"):
        samples = TexelSamples.of(observed, switches, options.texels, options.known)
        light = cell_radiance(observed.lighting.environment, CELLS)
        columns = columns_of(Transport.of(samples, CELLS), light, switches)
        level = scale_of(samples, columns, switches)
    views, wide = sum(capture.used), NINETY * level.sd
    gains = FoundGains(np.tile(level.best, (views, 1)), np.zeros(views), np.zeros(views, bool))
    uncertainty = LightUncertainty(scale=tuple(map(float, level.sd)))
    divided = replace(equalized(capture, gains), light_uncertainty=uncertainty)
    return divided, np.exp(level.best - wide), np.exp(level.best + wide)


def equalized(capture: Capture, gains: FoundGains) -> Capture:
    """Return the capture with photographs divided by their gains, and outliers marked unused.

    Args:
        capture: Capture; not modified.
        gains: Gains of its used photographs.

    Raises:
        CaptureError: The numbers of gains and used photographs differ, or all are outliers.

    Example:
        >>> svu.equalized(capture, gains).count
        12
    """
    kept = np.flatnonzero(capture.used)
    if len(kept) != len(gains.odd):
        raise CaptureError(
            f"{len(gains.odd)} gains for {len(kept)} used photographs; estimate the gains again."
        )
    if gains.odd.all():
        raise CaptureError("All photographs are outliers; check the capture with svu check.")
    images, used = list(capture.images), list(capture.used)
    clipped: list[Any] = list(capture.clipped) or [None] * capture.count
    rounding: list[Any] = list(capture.rounding) or [None] * capture.count
    buffer = PixelBuffer.allocate([capture.images[view].shape[1::-1] for view in kept])
    for room, view, factor, odd in zip(buffer.images, kept, gains.factor, gains.odd, strict=True):
        np.divide(capture.images[view], factor.astype(np.float32), out=room)
        images[view], used[view] = room, not odd
        clipped[view] = None if clipped[view] is None else clipped[view].divided(factor)
        rounding[view] = None if rounding[view] is None else rounding[view].divided(factor)
    return replace(
        capture, images=tuple(images), used=tuple(used), buffer=buffer,
        clipped=tuple(clipped) if capture.clipped else (),
        rounding=tuple(rounding) if capture.rounding else (),
    )  # fmt: skip


def starting_gains(samples: TexelSamples) -> FoundGains:
    """Return initial gains: 1, except for photographs much brighter or darker than others."""
    views = len(samples.cameras)
    grey = np.log(np.maximum(samples.radiance.mean(axis=1), 1e-6 * samples.unit))
    relative = grey - _medians(grey, samples.owner, samples.texels)[samples.owner]
    logarithm = _medians(relative, samples.view, views)
    logarithm = np.where(np.abs(logarithm) > FAR, logarithm, 0)
    return FoundGains(
        np.repeat(logarithm[:, None], 3, axis=1), np.zeros(views), np.zeros(views, bool)
    )


def without_gains(transport: Transport, gains: FoundGains | None) -> Transport:
    """Divide samples by gains, and set the weight of outliers to 0."""
    if gains is None:
        return transport
    samples = transport.samples
    samples = replace(samples, weight=np.where(gains.odd[samples.view], 0, samples.weight))
    return replace(transport, samples=samples.divided(gains.factor))


def step_gains(
    gains: FoundGains, samples: TexelSamples, system: NormalEquations, change: np.ndarray,
    noise: np.ndarray | None,
) -> tuple[FoundGains, np.ndarray]:  # fmt: skip
    """Apply one step to gains, after updating the outlier flags.

    Args:
        gains: Gains before the step.
        samples: Samples before division by gains.
        system: Normal equations with predicted samples.
        change: (V, 3) change of log gains; not applied to outliers.
        noise: (n,) noise of the texels; None keeps the flags.

    Returns:
        New gains, and the mean (3,) of their logarithms, which becomes part of the light.
    """
    left_out = gains.odd
    if noise is not None:
        gains = _with_outliers_flagged(gains, samples, system.predicted, noise)
    logarithm = gains.logarithm + np.where((gains.odd | left_out)[:, None], 0, change)
    common = np.asarray(logarithm[~gains.odd].mean(axis=0))
    return replace(gains, logarithm=logarithm - common), common


def _with_outliers_flagged(
    gains: FoundGains, samples: TexelSamples, predicted: np.ndarray, noise: np.ndarray
) -> FoundGains:
    """Flag photographs with unusual gains or residuals, given predicted samples (S, 3)."""
    logarithm, views = gains.logarithm, len(gains.odd)
    if gains.odd.any():  # the last step has skipped them
        least = 1e-6 * samples.unit
        ratio = np.log(np.maximum(samples.radiance, least) / np.maximum(predicted, least))
        own = [_medians(of_channel, samples.view, views) for of_channel in ratio.T]
        logarithm = np.where(gains.odd[:, None], np.stack(own, axis=1), logarithm)
    samples = samples.divided(np.exp(logarithm))
    error = np.square(samples.radiance - predicted).mean(axis=1)
    squares = samples.weight * error / noise[samples.owner] ** 2
    residual = np.sqrt(_medians(squares, samples.view, views))
    seen = residual > 0
    if seen.sum() < FEWEST:
        return replace(gains, logarithm=logarithm, noise=residual)
    grey, worse = logarithm.mean(axis=1), np.log(np.maximum(residual, 1e-30))
    grey, worse = (values - np.median(values[seen]) for values in (grey, worse))
    odd = _outliers(np.abs(grey), seen, ODD_GAIN) | _outliers(worse, seen, np.log(ODD_NOISE))
    return FoundGains(logarithm, residual, odd)


def _outliers(values: np.ndarray, seen: np.ndarray, limit: float) -> np.ndarray:
    """Return flags of ``seen`` values above a limit and above the usual spread."""
    spread = 1.48 * float(np.median(np.abs(values[seen])))
    return seen & (values > max(limit, SPREADS * spread))


def _medians(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Return the median of ``values`` for each index in ``group``; 0 for empty groups."""
    order = np.lexsort((values, group))
    size = np.bincount(group, minlength=count)
    middle = np.cumsum(size) - size + size // 2
    sorted_values = np.append(values[order], 0.0)
    return np.where(size > 0, sorted_values[np.minimum(middle, len(values))], 0)

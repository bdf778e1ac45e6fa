"""Photographs without their gains: found under a known light, and divided by."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.pixel_buffer import PixelBuffer
from svu_mi.capture.scene import require_light
from svu_mi.errors import CaptureError
from svu_mi.illumination.estimate import COOLING, HEAT, without_gains
from svu_mi.illumination.found_gains import FoundGains
from svu_mi.illumination.level import level_of
from svu_mi.illumination.materials import Moments, columns_of, tempered
from svu_mi.illumination.options import LightOptions
from svu_mi.illumination.record import NINETY
from svu_mi.illumination.refine import gains_system
from svu_mi.illumination.samples import Samples
from svu_mi.illumination.transport import Transport
from svu_mi.light.cells import even_radiance
from svu_mi.observed import Observed
from svu_mi.options import AngularPreset
from svu_mi.options import preset as find_preset
from svu_mi.pipeline import Estimate, observed_of
from svu_mi.progress import Progress
from svu_mi.surface import Texels

CELLS, ROUNDS = 1024, 12


def estimate_gains(
    source: Capture | Observed | Estimate,
    texels: Texels | None = None,
    options: LightOptions | None = None,
    progress: Progress | None = None,
) -> FoundGains:
    """Find the gains of photographs under the light that the capture has.

    Args:
        source: photographs, and their light.
        texels: of the object, some of which are looked at; those of the source if it has them.
        options: how many texels; nothing else of it is of matter.
        progress: shows what is going on.

    Returns:
        Gains of the photographs that are used, in their order.

    Raises:
        SceneError: there is no light, or it cannot be read.
        OptionError: no texels, or others than the source's.
        CaptureError: no texel is seen in enough photographs, or all of them are black.
    """
    options, progress = options or LightOptions(), progress or Progress()
    switches: AngularPreset = find_preset("default", method="angular")
    observed = observed_of(source, texels, progress)
    require_light(observed.capture)
    with progress.stage("Choosing texels"):
        samples = Samples.of(observed, switches, options.texels)
    with progress.stage("Finding gains", ROUNDS) as stage:
        light = even_radiance(observed.lighting.environment, CELLS)
        everything, gains = Transport.of(samples, CELLS), FoundGains.start(samples)
        columns, heat = columns_of(everything, light, switches), HEAT
        level = level_of(samples, columns, switches)
        if (np.abs(level.best) > NINETY * level.sd).any():  # in other units, maybe
            light = light * np.exp(level.best)
            columns = columns_of(everything, light, switches)
        for done in range(ROUNDS):
            now, transport = tempered(switches, heat), without_gains(everything, gains)
            posterior = Moments.of(transport.samples, columns).posterior(now)
            system = gains_system(
                transport, light, posterior, now.overdispersion, gains.logarithm
            )
            left_out = gains.odd
            if heat == 1:
                gains = gains.judged(samples, system.found, posterior.noise)
            gains, _ = gains.stepped(system.step(), left_out)
            heat = max(heat * COOLING, 1.0)
            stage.update(done + 1, ROUNDS)
    return gains


def equalized(capture: Capture, gains: FoundGains) -> Capture:
    """Return a capture whose photographs have no gains, and none of those that do not fit.

    Args:
        capture: it is not modified.
        gains: of the photographs that it uses.

    Raises:
        CaptureError: gains of another number of photographs, or none of them fits.
    """
    kept = np.flatnonzero(capture.used)
    if len(kept) != len(gains.odd):
        raise CaptureError(
            f"There are gains of {len(gains.odd)} photographs, but {len(kept)} are used; estimate "
            "them again."
        )
    if gains.odd.all():
        raise CaptureError("No photograph fits the others; look at them with svu check.")
    images, used = list(capture.images), list(capture.used)
    clipped: list[Any] = list(capture.clipped) or [None] * capture.count
    rounding: list[Any] = list(capture.rounding) or [None] * capture.count
    buffer = PixelBuffer.allocate([capture.images[view].shape[1::-1] for view in kept])
    for room, view, factor, odd in zip(
        buffer.images, kept, gains.factor, gains.odd, strict=True
    ):
        np.divide(capture.images[view], factor.astype(np.float32), out=room)
        images[view], used[view] = room, not odd
        clipped[view] = None if clipped[view] is None else clipped[view].divided(factor)
        rounding[view] = None if rounding[view] is None else rounding[view].divided(factor)
    return replace(
        capture, images=tuple(images), used=tuple(used), buffer=buffer,
        clipped=tuple(clipped) if capture.clipped else (),
        rounding=tuple(rounding) if capture.rounding else (),
    )  # fmt: skip

"""What a scene makes unnecessary: decided once, before the work, and said in the record.

Every decision leaves the result as it is, to rounding. What is *not* skipped, because it would
change the result: degrees that the band-limited light does not contain. Samples on part of a
sphere leak power from the degrees it has into those it has not, in the light's spectrum and in
the photographs' alike, and cutting both off is another fit (BENCHMARKS.md).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from svu_mi.capture.material import constant_parameters
from svu_mi.errors import OptionError
from svu_mi.observed import Observed
from svu_mi.options import AnyPreset, Skip
from svu_mi.posterior import ParameterGrid, PrincipledGrid
from svu_mi.posterior.streaming import IMPOSSIBLE

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is left to do.

    Attributes:
        channels: number of colour channels of the photographs to work on.
        light_channels: of the light; 1 for all when it is grey.
        copies: how many equal channels each of the photographs' stands for.
        levels: (R,) bool, roughness nodes to work on.
        skipped: what is left out, by reason, as counts.
    """

    channels: int
    light_channels: int
    copies: int
    levels: np.ndarray
    skipped: dict[str, int]


def make_plan(
    skip: Skip,
    switches: AnyPreset,
    observed: Observed,
    grid: ParameterGrid | PrincipledGrid,
    prior: tuple[np.ndarray, np.ndarray] | None,
) -> Plan:
    """Decide what to leave out.

    Args:
        skip: what may be.
        switches: the preset.
        observed: the photographs, their light, and which of them see which texels.
        grid: of parameters.
        prior: its tables, as ``streaming.log_prior`` has them.
    """
    grey_light = skip.channels and switches.colors == 3 and observed.lighting.environment.grey
    # Grey photographs of coloured light: no less work.
    grey = grey_light and observed.views.grey
    levels = np.ones(grid.shape[0], bool)
    if skip.levels and prior is not None:
        levels = np.any(prior[0].reshape(grid.shape[0], -1) < IMPOSSIBLE, axis=1)
    texels, capture = observed.texels, observed.capture
    width, height = texels.resolution
    skipped = {
        "texels outside the charts": width * height - texels.count - texels.overlapping,
        "texels on overlapping charts": texels.overlapping,
        "texels never seen": int((observed.shown == 0).sum()),
        "views left out": capture.count - sum(capture.used),
        "views that show no texel": int((observed.found.per_view == 0).sum()),
        "channels of the light equal to another": 2 if grey_light else 0,
        "channels of the photographs equal to another": 2 if grey else 0,
        "roughness levels that the prior excludes": int((~levels).sum()),
        "parameters known": len(grid.known),
    }
    for reason, count in skipped.items():
        if count:
            log.info("Skipped: %d %s.", count, reason)
    return Plan(
        channels=1 if grey else switches.colors,
        light_channels=1 if grey_light else switches.colors,
        copies=3 if grey else 1,
        levels=levels,
        skipped=skipped,
    )


def with_known(
    grid: ParameterGrid | PrincipledGrid, known: Mapping[str, float] | str | None, shape: Any
) -> Any:
    """Return a grid without the parameters that are known.

    Args:
        grid: of all parameters.
        known: values by name; ``"scene"`` for what the shape's material does not vary.
        shape: the object.

    Raises:
        OptionError: values that are not parameters of the grid, or not in [0, 1].
    """
    constants = constant_parameters(shape)
    constants = {name: value for name, value in constants.items() if name in grid.axes}
    if isinstance(known, str):
        if known != "scene":
            raise OptionError(f"known must be values by parameter, or 'scene', got {known!r}.")
        known = constants
    elif known is not None and not isinstance(known, Mapping):
        raise OptionError(f"known must be values by parameter, or 'scene', got {known!r}.")
    elif constants and not known:
        log.info(
            "The scene's material does not vary %s; if that is not a placeholder, known='scene' "
            "(--known scene) takes it as known.",
            " and ".join(constants),
        )
    return replace(grid, known={**grid.known, **known}) if known else grid

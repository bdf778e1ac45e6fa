"""Plan of an estimate: channels and roughness levels to compute.

Degrees above the band limit of the light are not skipped, because samples on a part of the sphere
leak power into them (notebooks/design/reflection.md).
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from svu_mi.capture.replace_material import constant_parameters
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.row_entropy import IMPOSSIBLE
from svu_mi.presets import AnyPreset, Skip

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Work of an estimate.

    Attributes:
        copies: number of equal colour channels per computed channel.
        levels: (R,) bool, mask of roughness nodes to compute.
        skipped: number of skipped items, by reason.
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
    """Return the plan and log skipped work; ``prior`` are ``log_prior`` tables."""
    grey_light = skip.channels and switches.colors == 3 and observed.grey_light(switches)
    # Grey photographs under coloured light need all three channels.
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
        "views that show no texel": int((observed.visibility.per_view == 0).sum()),
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
    grid: ParameterGrid | PrincipledGrid, known: Mapping[str, float] | Literal["scene"] | None,
    shape: Any,
) -> Any:  # fmt: skip
    """Return the grid with known values; ``"scene"`` selects the material's constants."""
    constants = constant_parameters(shape)
    constants = {name: value for name, value in constants.items() if name in grid.axes}
    if known == "scene":
        known = constants
    elif constants and not known:
        log.info(
            "The scene's material has a constant %s; unless it is a placeholder, use known='scene' "
            "(--known scene).",
            " and ".join(constants),
        )
    return replace(grid, known={**grid.known, **known}) if known else grid

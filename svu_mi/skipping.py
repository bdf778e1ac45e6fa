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
        observed: the photographs, their light, and who sees whom.
        grid: of parameters.
        prior: its tables, as ``streaming.log_prior`` has them.
    """
    grey_light = skip.channels and switches.colors == 3 and observed.lighting.environment.grey
    grey = grey_light and observed.views.grey  # grey photographs of coloured light: no less work
    levels = np.ones(grid.shape[0], bool)
    if skip.levels and prior is not None:
        levels = np.any(prior[0].reshape(grid.shape[0], -1) < IMPOSSIBLE, axis=1)
    plan = Plan(
        channels=1 if grey else switches.colors,
        light_channels=1 if grey_light else switches.colors,
        copies=3 if grey else 1,
        levels=levels,
        skipped={
            "channels of the light equal to another": 2 if grey_light else 0,
            "channels of the photographs equal to another": 2 if grey else 0,
            "roughness levels that the prior excludes": int((~levels).sum()),
            "parameters known": len(grid.known),
        },
    )
    _say(plan, observed, grid)
    return plan


def with_known(
    grid: ParameterGrid | PrincipledGrid, known: Mapping[str, float] | str | None, shape: Any
) -> Any:
    """Return a grid without the parameters that are known.

    Args:
        grid: of all parameters.
        known: values by name; ``"scene"`` for what the shape's material does not vary.
        shape: the object.

    Raises:
        OptionError: values that are no parameters of the grid, or not in [0, 1].
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
            "The scene's material does not vary %s; if that is a fact and no placeholder, "
            "known='scene' (--known scene) takes it out of the question.",
            " and ".join(constants),
        )
    return replace(grid, known={**grid.known, **known}) if known else grid


def _say(plan: Plan, observed: Observed, grid: ParameterGrid | PrincipledGrid) -> None:
    """Tell the log what is skipped, and which part of the work that is."""
    total, found = observed.texels.count, observed.found
    lines = []
    if unseen := total - len(observed.seen):
        part = 100 * unseen / total
        lines.append(f"{unseen} texels that no photograph shows: {part:.0f} % of fits and rays")
    if blind := len(found.per_view) - int(found.count[0]):
        lines.append(f"{blind} of {len(found.per_view)} views, which show no texel")
    if plan.copies > 1:
        lines.append("two of three colour channels, which are equal: two thirds of all sums")
    elif plan.light_channels < plan.channels:
        lines.append("two of three channels of the light, which are equal: a third of all sums")
    if not plan.levels.all():
        lines.append(f"{(~plan.levels).sum()} of {len(plan.levels)} levels of roughness")
    if grid.known:
        cells = int(np.prod([getattr(grid, name) for name in grid.known]))
        lines.append(f"known {', '.join(grid.known)}: the grid has {cells} times fewer cells")
    for line in lines:
        log.info("Skipped: %s.", line)

"""What recovery returns: textures, their coverage, and how they came about."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from svu_mi.errors import OptionError
from svu_mi.geometry.neighbors import Neighbors
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import NAMES
from svu_mi.posterior.estimate import Estimate
from svu_mi.recovery.recovery_options import Method
from svu_mi.recovery.svbrdf_textures import Textures


@dataclass(frozen=True, kw_only=True, repr=False)
class Recovery:
    """Recovered textures, and how they came about.

    Attributes:
        method: what they were recovered by.
        texels: the T texels they belong to.
        textures: base colour, roughness and metallic.
        coverage: (T,) uint32, number of photographs that show each texel; where it is 0, values
            come from neighbours and, if shared, from texels that look alike.
        losses: (N,) float32, of the last descent, before each step.
        stopped: why that ended: ``finished`` or ``converged``.
        settings: everything the result depends on, besides the capture.
        timings: seconds per stage, synchronised.
        estimate: posterior of every texel by itself, or with a prior in common; None if the
            recovery did not need one (``path``, losses of the paper).
        around: neighbours of the texels, None if the recovery did not need them.
    """

    method: Method
    texels: Texels
    textures: Textures
    coverage: np.ndarray
    losses: np.ndarray
    stopped: str
    settings: dict[str, Any]
    timings: dict[str, float] = field(default_factory=dict)
    estimate: Estimate | None = field(default=None, repr=False)
    around: Neighbors | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        width, height = self.texels.resolution
        return (
            f"<Recovery {self.method}: textures of {width} x {height}, {self.texels.count} texels, "
            f"{self.stopped} after {len(self.losses)} steps>"
        )

    def image(self, name: str) -> np.ndarray:
        """Return a map as (H, W) or (H, W, 3) float32: a texture, or ``coverage``.

        Raises:
            OptionError: an unknown name.
        """
        if name == "coverage":
            return self.texels.to_image(self.coverage.astype(np.float32), 0.0)
        if name not in NAMES:
            raise OptionError(
                f"Recovery.image(): there is no map {name!r}; use {', '.join(NAMES)} or coverage; "
                "Recovery.estimate.image() has entropy and standard deviations."
            )
        values = np.array(getattr(self.textures, name))
        return values if values.shape[2] > 1 else values[..., 0]

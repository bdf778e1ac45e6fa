"""Result of a recovery: textures, coverage, losses and settings."""

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
    """Recovered textures, with losses, settings and timings.

    Attributes:
        method: ``sh``, ``path`` or ``sh+path``.
        texels: The T texels of the textures.
        textures: Base colour, roughness and metallic.
        coverage: (T,) uint32, number of photographs that show each texel. Texels with 0 take
            values from neighbours and, with sharing, from similar texels.
        losses: (N,) float32, loss before each of the N steps of the last descent.
        stopped: ``finished`` if the descent took all steps, ``converged`` if it stopped early.
        settings: All settings that affect the result, except for the capture.
        timings: Seconds per stage, including the work of the device.
        estimate: Per-texel posterior, with a common prior if shared; None if unused (``path``,
            losses of the paper).
        around: Neighbours of the texels; None if unused.

    Example:
        >>> recovery.image("roughness").shape, recovery.image("base_color").shape
        ((64, 64), (64, 64, 3))
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
        """Return a texture, or ``coverage``, as (H, W) or (H, W, 3) float32.

        Raises:
            OptionError: The name is unknown.
        """
        if name == "coverage":
            return self.texels.to_image(self.coverage.astype(np.float32), 0.0)
        if name not in NAMES:
            raise OptionError(
                f"Recovery.image(): unknown map {name!r}; use {', '.join(NAMES)} or coverage. "
                "For entropy and standard deviations, use Recovery.estimate.image()."
            )
        values = np.array(getattr(self.textures, name))
        return values if values.shape[2] > 1 else values[..., 0]

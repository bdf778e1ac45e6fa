"""Settings of the paper's recovery: reflection models, and posterior for sharing.

If the source is an estimate with preset ``paper``, its options (such as the degree) are kept. Known
values and priors of roughness are always kept.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError
from svu_mi.geometry.neighbors import Neighbors
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.grid import ParameterGrid
from svu_mi.posterior.observations import Observed
from svu_mi.presets import preset
from svu_mi.recovery.initialisation import roughness_prior
from svu_mi.recovery.regularizers.global_sharing import PAPER_SETTINGS, SEEDS, GlobalSharing


@dataclass(frozen=True)
class PaperSettings:
    """Settings of the paper for one recovery.

    Attributes:
        given: Estimate passed to ``recover``, or None.
        known: Values of known parameters, by name.
    """

    given: Estimate | None
    known: Mapping[str, float]

    def switches(self, method: Literal["angular", "spectrum"]) -> Any:
        """Return the options of preset ``paper``, from the given estimate if it uses them."""
        own = self._paper_estimate(method)
        return preset("paper", method=method) if own is None else own.preset

    def _paper_estimate(self, method: str) -> Estimate | None:
        """Return the given estimate if it has preset ``paper`` and this method, else None."""
        given = self.given
        is_own = given and given.method == method and given.preset.name == "paper"
        return given if is_own else None

    def record(self) -> dict[str, Any]:
        """Return the settings of sharing (Eq. 14, 15) and of the posterior in its weights."""
        grid, prior = self._grid_and_prior()
        posterior = {
            "method": "spectrum", **asdict(self.switches("spectrum")), "grid": asdict(grid),
            "prior": None if prior is None else np.asarray(prior).tolist(),
        }  # fmt: skip
        return {"seeds": SEEDS, **PAPER_SETTINGS, "posterior": posterior}

    def sharing(self, observed: Observed, around: Neighbors, progress: Progress) -> GlobalSharing:
        """Return the sharing of Eq. 14 and 15, with seeds from the posterior of Eq. 11."""
        certain = self._spectrum_estimate()
        if certain is None:
            grid, prior = self._grid_and_prior()
            certain = estimate(
                observed, method="spectrum", preset=self.switches("spectrum"), grid=grid,
                prior=prior, progress=progress,
            )  # fmt: skip
        with progress.stage("Finding seeds"):
            return GlobalSharing.printed(certain, around)

    def _spectrum_estimate(self) -> Estimate | None:
        """Return the given estimate if it is the paper's posterior over (roughness, Ks)."""
        own = self._paper_estimate("spectrum")
        return own if own and isinstance(own.posterior.grid, ParameterGrid) else None

    def _grid_and_prior(self) -> tuple[ParameterGrid, Any | None]:
        """Return the grid of Eq. 11, and the prior of roughness or None."""
        if (given := self._spectrum_estimate()) is not None:
            grid = given.posterior.grid
            assert isinstance(grid, ParameterGrid)
            return grid, given.prior
        grid = ParameterGrid(
            known={name: value for name, value in self.known.items() if name == "roughness"}
        )
        prior = None if self.given is None else roughness_prior(self.given)
        if prior is not None and len(prior) != grid.shape[0]:
            raise OptionError(
                f"recover(): the estimate's prior has {len(prior)} roughness nodes, but the grid "
                f"of Eq. 11 has {grid.shape[0]}; use {grid.shape[0]} nodes, or no prior."
            )
        return grid, prior

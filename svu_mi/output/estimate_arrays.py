"""Values of an estimate as NumPy arrays, and labels of parameters, for pages."""

from typing import TYPE_CHECKING

import numpy as np

from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.posterior import Posterior

if TYPE_CHECKING:
    from svu_mi.recovery.recovery_result import Recovery

LOWEST_PART = 0.1  # fraction of the texels, of lowest entropy, with their own mean marginal
SAMPLE = 2_000  # texels of a mean marginal


def entropies(estimate: Estimate) -> np.ndarray:
    """Return the normalised entropy of texels, (T,) float32."""
    return np.array(estimate.entropy, np.float32)


def coverages(estimate: "Estimate | Recovery") -> np.ndarray:
    """Return the number of views that see each texel, (T,) int64."""
    return np.array(estimate.coverage).astype(np.int64)


def is_seen(estimate: "Estimate | Recovery") -> np.ndarray:
    """Return flags of texels that at least one view sees, (T,) bool."""
    return coverages(estimate) > 0


def texel_areas(estimate: "Estimate | Recovery") -> np.ndarray:
    """Return the surface area of each texel, (T,) float64."""
    return np.array(estimate.texels.footprint, np.float64) ** 2


def column_and_row(estimate: Estimate, texel: int) -> tuple[int, int]:
    """Return column and row of a texel in the texture."""
    row, column = divmod(int(estimate.texels.index.numpy()[texel]), estimate.texels.resolution[0])
    return column, row


def label_of(name: str) -> str:
    """Return the label of a parameter: base colour, roughness, ..."""
    return name.replace("_", " ").replace("color", "colour")


def open_axes(estimate: Estimate) -> dict[str, np.ndarray]:
    """Return the grid nodes of the unknown parameters, by name."""
    return {name: nodes for name, nodes in estimate.posterior.axes.items() if len(nodes) > 1}


def known_values(estimate: Estimate) -> dict[str, float]:
    """Return the values of the known parameters, by name."""
    axes = estimate.posterior.axes.items()
    return {name: float(nodes[0]) for name, nodes in axes if len(nodes) == 1}


def prior_marginal(posterior: Posterior, name: str) -> np.ndarray:
    """Return the prior's marginal (nodes,) of a parameter."""
    others = tuple(k for k, other in enumerate(posterior.axes) if other != name)
    return np.asarray(posterior.prior.sum(axis=others))


def mean_marginals(estimate: Estimate) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return mean marginals of all seen texels, and of the 10 % with the lowest entropy.

    Marginals are by parameter, (nodes, 1), or (nodes, 3) if the channels differ. At least one texel
    must be seen.
    """
    entropy, seen = entropies(estimate), is_seen(estimate)
    limit = np.quantile(entropy[seen], LOWEST_PART)

    def mean(of: np.ndarray) -> dict[str, np.ndarray]:
        every = np.flatnonzero(of)
        some = every[:: max(len(every) // SAMPLE, 1)]
        marginals = {}
        for name, table in estimate.posterior.marginals(some).items():
            p = np.array(table, np.float64)
            marginals[name] = p.reshape(len(some), p.shape[1], -1).mean(axis=0)
        return marginals

    return mean(seen), mean(seen & (entropy <= limit))

"""Global sharing: uncertain texels are pulled towards certain ones (Sec. 5.2, Eq. 14, 15)."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.core.validation import require, require_types
from svu_mi.errors import OptionError
from svu_mi.geometry.texels import Texels
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.posterior import Posterior
from svu_mi.recovery.regularizers.known_gradient import Regularizer
from svu_mi.recovery.regularizers.sharing_seeds import find_seeds, least_minima

Divergence = Literal["forward", "reverse"]
Seeding = Literal["spread", "least"]

SEEDS, TAU = 20, 0.4  # as in the paper
PAPER_SETTINGS: dict[str, Any] = {
    "tau": TAU, "seeding": "least", "divergence": "forward", "anchored": False,
}  # fmt: skip

CHUNK = 1 << 22  # probabilities in memory at a time
LEAST = 1e-30  # probability that stands for 0 in a logarithm


@dataclass(frozen=True, eq=False)
class GlobalSharing(Regularizer):
    """Squared distance to seeds: certain texels of the surface.

        L_S(psi) = 1/T sum over texels p, sum over seeds q of w_pq |psi_p - psi_q|^2   (Eq. 14)
        w_pq = exp(-KL_pq^2 / (2 tau'^2)),  tau' = tau times the mean of all KL_pq     (Eq. 15)

    A plain function of a texture, to be added to any loss. The weights come from posteriors
    and do not change; the seeds' values are those of the texture itself. Weights are not
    normalised: a texel that is like no seed is left alone. A texel that nobody saw has the
    prior for its posterior, which says next to nothing of how far it is from a seed.

    As the paper prints it: ``GlobalSharing.printed``. The defaults are ours.

    Attributes:
        estimate: what the photographs say about T texels.
        mesh: the mesh they lie on; or their ``Neighbors``, if these are at hand; or None, to
            look for seeds without crossing seams.
        seeds: how many at most; or the numbers of texels to use, in [0, T). Afterwards those
            numbers, (S,) int64; none if no texel was ever seen.
        tau: width of the weights, as a part of the mean KL divergence; 0.4 in the paper.
        seeding: how a number of seeds is chosen: ``spread`` over the materials, among smoothed
            minima of the entropy (``find_seeds``); or the paper's ``least`` of all local minima
            (``least_minima``), which may all be of one material.
        divergence: ``reverse`` is KL(P_q || P_p), which asks whether what p saw allows for the
            seed; ``forward`` is the paper's KL(P_p || P_q), which asks whether the seed allows
            for all that p does, and is far for every uncertain p.
        anchored: seeds pull and are not pulled: the gradient reaches p only. If not, it is that
            of Eq. 14 by both psi_p and psi_q.
        weights: (S T,) Float, that of seed s and texel p at s T + p.
    """

    estimate: Estimate
    mesh: Any | None = None
    _: KW_ONLY
    seeds: Any = SEEDS
    tau: float = TAU
    seeding: Seeding = "spread"
    divergence: Divergence = "reverse"
    anchored: bool = True
    weights: Any = field(init=False, repr=False)
    _seeds: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        require_types(self)
        require(self, 0 < self.tau < np.inf, "tau", "positive")
        posterior = self.estimate.posterior
        chosen = self._chosen_seeds()
        weights = _weights(divergences(posterior, chosen, self.divergence), self.tau)
        object.__setattr__(self, "seeds", chosen)
        object.__setattr__(self, "weights", to_drjit(mi.Float, weights.ravel()))
        object.__setattr__(self, "_seeds", to_drjit(mi.UInt32, chosen.astype(np.uint32)))

    @classmethod
    def printed(
        cls, estimate: Estimate, mesh: Any | None = None, *, seeds: Any = SEEDS
    ) -> GlobalSharing:
        """Return the sharing that the paper prints (Sec. 5.2, Eq. 14 and 15).

        Seeds are the 20 least local minima of the entropy on the surface, KL(P_p || P_q) is the
        forward one, tau' is 0.4 times its mean over seeds and all texels, and both texels of a
        pair are pulled. P is that of the estimate: in the paper that of Eq. 11, over 8 x 8 cells
        of (roughness, Ks), ``estimate(..., method="spectrum", preset="paper")``.

        Args:
            estimate: what the photographs say about T texels.
            mesh: as for the class.
            seeds: as for the class.

        Raises:
            OptionError: fewer than one seed.
        """
        return cls(estimate, mesh, seeds=seeds, **PAPER_SETTINGS)

    def record(self) -> dict[str, Any]:
        """Return how texels share, for a run's settings: all but posteriors and seeds' places."""
        names = ("tau", "seeding", "divergence", "anchored")
        return {"seeds": len(self.seeds)} | {name: getattr(self, name) for name in names}

    def _texels(self) -> Texels:
        return self.estimate.texels

    def pull(self) -> np.ndarray:
        """Return W_p = sum over seeds of w_pq, (T,) float32: how much each texel is pulled."""
        count = self.estimate.texels.count
        weights = np.array(self.weights, np.float64).reshape(len(self.seeds), count)
        return weights.sum(axis=0).astype(np.float32)

    def image(self) -> np.ndarray:
        """Lay ``pull`` out as an (H, W) float32 texture, 0 outside the charts."""
        return self.estimate.texels.to_image(self.pull())

    def _chosen_seeds(self) -> np.ndarray:
        """Return the numbers of the seeds, (S,) int64."""
        if not isinstance(self.seeds, (int, np.integer)):
            chosen = np.array(self.seeds, np.int64).reshape(-1)
            return chosen[np.sort(np.unique(chosen, return_index=True)[1])]
        if self.seeds < 1:
            raise OptionError(f"GlobalSharing: it takes at least one seed, got {self.seeds}.")
        around, count = self._neighbors(self.mesh), int(self.seeds)
        if self.seeding == "spread":
            return find_seeds(self.estimate, around, count)
        entropy = np.array(self.estimate.entropy, np.float64)
        return least_minima(entropy, np.array(self.estimate.coverage) > 0, around, count)

    def _of(self, values: Any, channels: int) -> tuple[Any, Any]:
        """Value and gradient: every lane is a texel that reads from all seeds."""
        if len(self.seeds) == 0:
            return mi.Float(0), dr.zeros(mi.Float, dr.width(values))
        index = self.estimate.texels.index
        psi = [dr.gather(mi.Float, values, index * channels + c) for c in range(channels)]
        seeds = [dr.gather(mi.Float, column, self._seeds) for column in psi]
        dr.eval(psi, seeds)
        total, pull = self._pull(psi, seeds)
        dr.eval(total, pull)
        scale = 1 / dr.opaque(mi.Float, self.estimate.texels.count)
        gradient = dr.zeros(mi.Float, dr.width(values))
        for c in range(channels):
            dr.scatter(gradient, 2 * scale * pull[c], index * channels + c)
        if not self.anchored:
            # Now: writes and additions that wait for one evaluation have no order among them.
            dr.eval(gradient)
            self._add_seed_gradient(gradient, psi, seeds, 2 * scale)
        return dr.sum(total) * scale, gradient

    def _pull(self, psi: list[Any], seeds: list[Any]) -> tuple[Any, list[Any]]:
        """Return sum_q w_pq |psi_p - psi_q|^2 and, by channel, sum_q w_pq (psi_p - psi_q)."""
        lane = dr.arange(mi.UInt32, self.estimate.texels.count)
        stride = dr.opaque(mi.UInt32, self.estimate.texels.count)
        count = dr.opaque(mi.UInt32, len(self.seeds))

        def body(seed: Any, total: Any, *pull: Any) -> tuple[Any, ...]:
            weight = dr.gather(mi.Float, self.weights, seed * stride + lane)
            moved = []
            for here, there, force in zip(psi, seeds, pull, strict=True):
                apart = here - dr.gather(mi.Float, there, seed)
                total = dr.fma(weight, dr.square(apart), total)
                moved.append(dr.fma(weight, apart, force))
            return seed + 1, total, *moved

        start = (dr.zeros(mi.Float, self.estimate.texels.count) for _ in range(len(psi) + 1))
        _, total, *pull = dr.while_loop(
            state=(mi.UInt32(0), *start), cond=lambda seed, *_: seed < count, body=body
        )
        return total, pull

    def _add_seed_gradient(
        self, gradient: Any, psi: list[Any], seeds: list[Any], scale: Any
    ) -> None:
        """Add the gradient at the seeds: - sum_p w_pq (psi_p - psi_q)."""
        count, index = self.estimate.texels.count, self.estimate.texels.index
        lane = dr.arange(mi.UInt32, dr.width(self.weights))
        seed = lane // dr.opaque(mi.UInt32, count)
        texel = lane - seed * dr.opaque(mi.UInt32, count)
        at = dr.gather(mi.UInt32, index, self._seeds) * len(psi)
        for c, (here, there) in enumerate(zip(psi, seeds, strict=True)):
            apart = dr.gather(mi.Float, here, texel) - dr.gather(mi.Float, there, seed)
            force = scale * dr.block_sum(self.weights * apart, count)
            dr.scatter_add(gradient, -force, at + c, mode=dr.ReduceMode.NoConflicts)


def divergences(posterior: Posterior, chosen: np.ndarray, kind: Divergence) -> np.ndarray:
    """Return KL(P_p || P_q), or KL(P_q || P_p) if reverse, of all texels p to some texels q.

    Where each channel has a distribution of its own, the mean over channels.
    """
    q = _probabilities(posterior, chosen)
    log_q = np.log(np.maximum(q, LEAST))
    result = np.empty((len(chosen), posterior.count))
    every, size = np.arange(posterior.count), max(CHUNK // max(q.shape[1], 1), 1)
    for texels in np.split(every, range(size, len(every), size)):
        p = _probabilities(posterior, texels)
        log_p = np.log(np.maximum(p, LEAST))
        if kind == "forward":
            result[:, texels] = np.einsum("tk,tk->t", p, log_p) - log_q @ p.T
        else:
            result[:, texels] = np.einsum("sk,sk->s", q, log_q)[:, None] - q @ log_p.T
    return np.maximum(result, 0) / posterior.channels


def _probabilities(posterior: Posterior, chosen: np.ndarray) -> np.ndarray:
    """Return (t, cells) float32 probabilities of some texels, all channels in a row."""
    cells = int(np.prod(posterior.grid.shape)) * posterior.channels
    return np.array(posterior.probabilities_of(chosen), np.float32).reshape(len(chosen), cells)


def _weights(divergence: np.ndarray, tau: float) -> np.ndarray:
    """Return w = exp(-KL^2 / (2 tau'^2)), (S, T) float32 (Eq. 15)."""
    width = tau * divergence.mean() if divergence.size else 0.0
    if width == 0:  # all posteriors are the same
        return np.ones(divergence.shape, np.float32)
    return np.exp(-0.5 * (divergence / width) ** 2).astype(np.float32)

"""Global sharing: a regulariser between uncertain and certain texels (Eq. 14, 15)."""

from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold, to_drjit
from svu_mi.core.validation import indices_of, require, require_types
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

CHUNK = 1 << 22  # probabilities per chunk, to limit memory
LEAST = 1e-30  # lower limit of probabilities in logarithms


@dataclass(frozen=True, eq=False)
class GlobalSharing(Regularizer):
    """Weighted squared distance to seeds, which are texels of low entropy.

        L_S(psi) = 1/T sum over texels p, sum over seeds q of w_pq |psi_p - psi_q|^2   (Eq. 14)
        w_pq = exp(-KL_pq^2 / (2 tau'^2)),  tau' = tau times the mean of all KL_pq     (Eq. 15)

    Call an instance with a texture, and add the result to any loss. Weights are constants that
    follow from the posteriors P; values psi_q are read from the texture. Weights are not
    normalised: texels similar to no seed are not changed. The weight of an unseen texel hardly
    depends on the seed, because its posterior is the prior.

    ``GlobalSharing.printed`` has the settings of the paper; the defaults differ.

    Attributes:
        estimate: Estimate of T texels, with their posteriors.
        mesh: Mesh of the texels, or their ``Neighbors``; None for neighbours in the map, which
            do not cross seams.
        seeds: Maximum number of seeds, >= 1 (default 20, as in the paper), or texel indices in
            [0, T). After construction: texel indices, (S,) int64; empty if no texel is observed.
        tau: Width of the weights relative to the mean KL divergence, > 0 (default 0.4, as in the
            paper). Lower it to share among more similar texels only.
        seeding: Selection of seeds. ``spread`` (default): minima of the smoothed entropy, spread
            over materials (``find_seeds``). ``least``: the paper's least local minima
            (``least_minima``), which may all belong to one material.
        divergence: ``reverse`` (default): KL(P_q || P_p), small if the seed is plausible for
            texel p. ``forward``: the paper's KL(P_p || P_q), large for all uncertain texels.
        anchored: True (default) for gradients in psi_p only; False for the gradient of Eq. 14,
            which also moves seeds.
        weights: (S T,) Float, weight of seed s and texel p at index s T + p.

    Raises:
        OptionError: A setting is invalid, such as less than one seed.

    Example:
        >>> sharing = svu.GlobalSharing(estimate, capture.mesh, seeds=4)
        >>> recovered = svu.recover(estimate, sharing=sharing)
        >>> sharing.image().shape
        (64, 64)
    """

    estimate: Estimate
    mesh: Any | None = field(default=None, repr=False)
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
    ) -> "GlobalSharing":
        """Return the sharing with the settings of the paper (Sec. 5.2, Eq. 14 and 15).

        Seeds are the 20 least local minima of the entropy on the surface. The divergence is
        KL(P_p || P_q), and gradients reach both texels of a pair. For the posterior of the paper
        (Eq. 11), ``estimate`` needs ``method="spectrum", preset="paper"``.
        """
        return cls(estimate, mesh, seeds=seeds, **PAPER_SETTINGS)

    def record(self) -> dict[str, Any]:
        """Return the number of seeds and all settings, for the record of a run."""
        names = ("tau", "seeding", "divergence", "anchored")
        return {"seeds": len(self.seeds)} | {name: getattr(self, name) for name in names}

    @property
    def texels(self) -> Texels:  # type: ignore[override]
        """Texels of the estimate."""
        return self.estimate.texels

    def pull(self) -> np.ndarray:
        """Return the total weight of each texel, sum over seeds of w_pq, (T,) float32."""
        count = self.texels.count
        weights = np.array(self.weights, np.float64).reshape(len(self.seeds), count)
        return weights.sum(axis=0).astype(np.float32)

    def image(self) -> np.ndarray:
        """Return ``pull`` as an (H, W) float32 image, 0 outside the charts."""
        return self.texels.to_image(self.pull())

    def _chosen_seeds(self) -> np.ndarray:
        """Return the texel indices of the seeds, (S,) int64."""
        if not isinstance(self.seeds, (int, np.integer)):
            chosen = indices_of(self.seeds, self.texels.count, "GlobalSharing", "texel")
            return chosen[np.sort(np.unique(chosen, return_index=True)[1])]
        if self.seeds < 1:
            raise OptionError(f"GlobalSharing: seeds must be at least 1, got {self.seeds}.")
        around, count = self._neighbors(self.mesh), int(self.seeds)
        if self.seeding == "spread":
            return find_seeds(self.estimate, around, count)
        entropy = np.array(self.estimate.entropy, np.float64)
        return least_minima(entropy, np.array(self.estimate.coverage) > 0, around, count)

    def _of(self, values: Any, channels: int) -> tuple[Any, Any]:
        """Return value and gradient; each lane is a texel and loops over all seeds."""
        if len(self.seeds) == 0:
            return mi.Float(0), dr.zeros(mi.Float, dr.width(values))
        index = self.texels.index
        psi = [dr.gather(mi.Float, values, index * channels + c) for c in range(channels)]
        seeds = [dr.gather(mi.Float, column, self._seeds) for column in psi]
        dr.eval(psi, seeds)
        total, pull = self._pull(psi, seeds)
        dr.eval(total, pull)
        scale = 1 / dr.opaque(mi.Float, self.texels.count)
        gradient = dr.zeros(mi.Float, dr.width(values))
        for c in range(channels):
            dr.scatter(gradient, 2 * scale * pull[c], index * channels + c)
        if not self.anchored:
            # Evaluate first: the order of scatters within one kernel is undefined.
            dr.eval(gradient)
            self._add_seed_gradient(gradient, psi, seeds, 2 * scale)
        return dr.sum(total) * scale, gradient

    def _pull(self, psi: list[Any], seeds: list[Any]) -> tuple[Any, list[Any]]:
        """Return sum_q w_pq |psi_p - psi_q|^2 and, by channel, sum_q w_pq (psi_p - psi_q)."""
        lane = dr.arange(mi.UInt32, self.texels.count)
        stride = dr.opaque(mi.UInt32, self.texels.count)
        count = dr.opaque(mi.UInt32, len(self.seeds))

        def body(seed: Any, total: Any, *pull: Any) -> tuple[Any, ...]:
            weight = dr.gather(mi.Float, self.weights, seed * stride + lane)
            moved = []
            for here, there, force in zip(psi, seeds, pull, strict=True):
                apart = here - dr.gather(mi.Float, there, seed)
                total = dr.fma(weight, dr.square(apart), total)
                moved.append(dr.fma(weight, apart, force))
            return seed + 1, total, *moved

        start = (dr.zeros(mi.Float, self.texels.count) for _ in range(len(psi) + 1))
        total, *pull = fold(0, count, body, *start)
        return total, pull

    def _add_seed_gradient(
        self, gradient: Any, psi: list[Any], seeds: list[Any], scale: Any
    ) -> None:
        """Add the gradient at the seeds: - sum_p w_pq (psi_p - psi_q)."""
        count, index = self.texels.count, self.texels.index
        lane = dr.arange(mi.UInt32, dr.width(self.weights))
        seed = lane // dr.opaque(mi.UInt32, count)
        texel = lane - seed * dr.opaque(mi.UInt32, count)
        at = dr.gather(mi.UInt32, index, self._seeds) * len(psi)
        for c, (here, there) in enumerate(zip(psi, seeds, strict=True)):
            apart = dr.gather(mi.Float, here, texel) - dr.gather(mi.Float, there, seed)
            force = scale * dr.block_sum(self.weights * apart, count)
            dr.scatter_add(gradient, -force, at + c, mode=dr.ReduceMode.NoConflicts)


def divergences(posterior: Posterior, chosen: np.ndarray, kind: Divergence) -> np.ndarray:
    """Return KL divergences between all texels p and chosen texels q, (S, T).

    ``forward`` is KL(P_p || P_q), ``reverse`` KL(P_q || P_p). Separate distributions per channel
    are averaged.
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
    """Return probabilities (t, cells) of chosen texels, with channels concatenated."""
    cells = int(np.prod(posterior.grid.shape)) * posterior.channels
    return np.array(posterior.probabilities_of(chosen), np.float32).reshape(len(chosen), cells)


def _weights(divergence: np.ndarray, tau: float) -> np.ndarray:
    """Return the weights of Eq. 15, w = exp(-KL^2 / (2 tau'^2)), (S, T) float32."""
    width = tau * divergence.mean() if divergence.size else 0.0
    if width == 0:  # all posteriors are equal
        return np.ones(divergence.shape, np.float32)
    return np.exp(-0.5 * (divergence / width) ** 2).astype(np.float32)

"""Materials: parameters that many texels share, estimated from all of them at once.

Global sharing (Sec. 5.2) pulls an uncertain texel towards certain ones whose posteriors are
alike. Here the posteriors are those of the statistics, at the seeds' very parameters,

    w_pq ~ exp(-(d_p(psi_q) - min d_p) / (2 variance_p)),

and a seed is not one texel: its parameters minimise the error of every texel that it explains,
whose sums simply add up. A texel sees a material from some directions, all texels together
from nearly all, so what no texel can tell for itself, such as metal from plastic, they can.
The two steps alternate, as in expectation maximisation [Dempster, Laird and Rubin 1977].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.recovery.sh.energy import energy
from svu_mi.recovery.sh.gradient import carry, look_up
from svu_mi.recovery.sh.start import Start, closed_form
from svu_mi.statistics import Factors, Statistics
from svu_mi.statistics.gather import Values

ROUNDS = 8
SAMPLE = 12_000  # texels that materials are found with; weights are those of all
SHARPNESS = 8.0  # errors of a texel's views do not all point the same way
DOUBT = 8.0  # how fast trust falls off with what a material leaves unexplained
NO_MATERIAL = 0.3  # trust below which a material is given up
POOL = 100.0  # independent errors among those of a material's texels
WELL_SEEN = 0.5  # quantile of coverage from which a texel can tell that a material is wrong


@dataclass(frozen=True)
class Materials:
    """K materials, and what S texels have to do with them.

    Attributes:
        values: (K, 5) float64: red, green, blue, roughness and metallic.
        weights: (K, S) float32 in [0, 1]: how sure it is that a texel is of a material; their
            sum is at most 1.
        trust: (K,) in [0, 1]: how well a material explains those of its texels that are well
            seen. Where nothing repeats, it is near 0.
    """

    values: np.ndarray
    weights: np.ndarray
    trust: np.ndarray

    def blend(self, own: np.ndarray) -> np.ndarray:
        """Move parameters of S texels (5, S) towards their materials'."""
        return own * (1 - self.weights.sum(axis=0)) + self.values.T @ self.weights


@dataclass(frozen=True)
class MaterialSharing:
    """Squared distance of texels to their materials: Eq. 14, with seeds that do not move.

    Attributes:
        place: (S,) UInt32, where in a texture each texel is.
        pull: (S,) Float, sum of a texel's weights.
        target: five (S,) Floats, the weighted mean of its materials.
    """

    place: Any
    pull: Any
    target: Values

    @staticmethod
    def of(materials: Materials, place: Any) -> MaterialSharing:
        """Prepare the weights; the loss then costs the same for any number of materials."""
        pull = materials.weights.sum(axis=0)
        target = (materials.values.T @ materials.weights) / np.maximum(pull, 1e-9)
        return MaterialSharing(place, owned(mi.Float, pull), values_of(target))

    def __call__(self, textures: dict[str, Any]) -> Any:
        """Return 1/S sum_p w_p |psi_p - target_p|^2, a Float of one value."""
        values = look_up(textures, self.place)
        with dr.suspend_grad():
            offsets = [dr.detach(v) - t for v, t in zip(values, self.target, strict=True)]
            loss = self.pull * sum(dr.square(offset) for offset in offsets)
            slopes = [2 * self.pull * offset for offset in offsets]
            dr.eval(loss, slopes)
        return carry(loss, slopes, values, dr.opaque(mi.Float, 1 / dr.width(self.pull)))


def values_of(table: np.ndarray) -> Values:
    """Return parameters (5, S) as Floats."""
    return Values(*(owned(mi.Float, row) for row in table))


def find_materials(
    factors: Factors, start: Start, own: np.ndarray, seeds: np.ndarray, seed: int = 0
) -> Materials:
    """Find the materials of an object.

    Args:
        factors: of S texels.
        start: their least errors, and variances.
        own: (5, S) their parameters, as far as each knows for itself.
        seeds: (K,) numbers of texels, among S, whose parameters materials start from.
        seed: of the choice of ``SAMPLE`` texels.
    """
    if len(seeds) == 0:
        none = np.zeros((0, factors.count), np.float32)
        return Materials(np.zeros((0, 5)), none, np.zeros(0))
    values = own[:, seeds].T.astype(np.float64)
    rng = np.random.default_rng(seed)
    chosen = np.arange(factors.count)
    if factors.count > SAMPLE:
        chosen = np.sort(rng.choice(factors.count, SAMPLE, replace=False))
    sample = factors.some(chosen)
    least, variance = (x.numpy()[chosen] for x in (start.least, start.variance))
    products = sample.products()
    for _ in range(ROUNDS):
        share = _shares(_excess(sample, values, least, variance))
        values = _pooled(sample, products, share / variance, values)
    excess = _excess(factors, values, start.least.numpy(), start.variance.numpy())
    # What does not explain its own texels is no material; they may be of another that is.
    kept = _trust(excess, factors.views.numpy()) >= NO_MATERIAL
    values, excess = values[kept], excess[kept]
    if not kept.any():
        return Materials(values, excess.astype(np.float32), np.zeros(0))
    trust = _trust(excess, factors.views.numpy())
    weights = _shares(excess) * trust[:, None]
    return Materials(values, weights.astype(np.float32), trust)


def _excess(
    factors: Factors, values: np.ndarray, least: np.ndarray, variance: np.ndarray
) -> np.ndarray:
    """(K, S): how much less likely a material is than a texel's best parameters, in nats."""
    rows = owned(mi.Float, values.ravel())
    count = factors.count
    result, stride = dr.zeros(mi.Float, len(values) * count), dr.opaque(mi.UInt32, count)
    lane, last = dr.arange(mi.UInt32, count), dr.opaque(mi.UInt32, len(values))

    def body(number: Any) -> tuple[Any]:
        row = Values(*(dr.gather(mi.Float, rows, 5 * number + k) for k in range(5)))
        dr.scatter(result, energy(factors, row)[0], number * stride + lane)
        return (number + 1,)

    dr.while_loop(state=(dr.zeros(mi.UInt32, count),), cond=lambda n: n < last, body=body)
    error = result.numpy().reshape(len(values), count)
    return np.maximum(error - least, 0) / (2 * variance)


def _shares(excess: np.ndarray) -> np.ndarray:
    """(K, S): which material a texel is of, times whether it is of any (Eq. 15)."""
    nearest = excess.min(axis=0)
    share = np.exp(-SHARPNESS * (excess - nearest))
    return share / share.sum(axis=0) * np.exp(-nearest)


def _pooled(
    sample: Factors, products: np.ndarray, weights: np.ndarray, values: np.ndarray
) -> np.ndarray:
    """Return the parameters (K, 5) that explain the texels of each material best."""
    total = weights.sum(axis=1)
    used = total > 1e-6 * total.max()
    sums = products @ weights[used].T
    pooled = Statistics.of(sums, total[used], np.ones(used.sum()), sample.roughness)
    scale = float(np.sqrt(np.abs(sums / total[used]).max()))
    found = closed_form(pooled.factor(), dr.opaque(mi.Float, 1e-3 * scale), POOL).table().T
    result = values.copy()
    result[used] = np.where(np.isfinite(found), found, values[used])
    return result


def _trust(excess: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """(K,): exp(-DOUBT m), m the median excess of a material's texels that are well seen."""
    able = coverage >= np.quantile(coverage, WELL_SEEN)
    nearest = excess.argmin(axis=0)
    trust = np.zeros(len(excess))
    for k in range(len(excess)):
        members = able & (nearest == k)
        if members.any():
            trust[k] = np.exp(-DOUBT * np.median(excess[k, members]))
    return trust

"""The fit (Eq. 12) and power spectra (Eq. 8): any views, degrees, light."""

from __future__ import annotations

import numpy as np
import pytest
from oracle import frequency
from oracle.rounding import SPECTRUM

import svu_mi as svu
from numerics.samples import assert_within, fit_samples
from svu_mi.frequency import fit_sh, power_spectrum


def assert_fit(d, w, f, lmax=6, regularizer=1e-3, base="default"):
    """Every degree's power, as a part of the largest of its texel and channel.

    It may be off by what ``fit_sh`` promises, and what even double precision loses where the
    equilibrated matrix is close to singular.
    """
    penalized = svu.preset(base).penalize_constant
    truth = frequency.power(frequency.fit(d, w, f, lmax, regularizer, penalized))
    ours = np.array(power_spectrum(fit_sh(d, w, f, lmax, regularizer, base)), np.float64)
    size = np.maximum(truth.max(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    spread = [condition(d[t], w[t], lmax, regularizer, penalized) for t in range(len(d))]
    bounds = SPECTRUM + 4 * (lmax + 1) ** 2 * 2.0**-53 * np.array(spread)
    assert_within(ours / size, truth / size, bounds[:, None, None])


def condition(d, w, lmax, regularizer, penalized):
    """Condition of a texel's normal equations with a diagonal of ones; 0 if it sees nothing."""
    seen = w > 0
    if not seen.any():
        return 0.0
    nothing = np.zeros((int(seen.sum()), 0))
    Y = frequency.basis(d[seen], lmax)
    matrix, _ = frequency.normal_equations(Y, w[seen], nothing, regularizer, penalized)
    scale = 1 / np.sqrt(np.diag(matrix))
    return float(np.linalg.cond(scale[:, None] * matrix * scale))


def test_degree_9_is_the_last():
    """dr.sh_eval ends there."""
    assert_fit(*fit_samples(2003, 40), 9)
    with pytest.raises(svu.SvuError, match=r"degree must be a whole number in \[0, 9\], got 10"):
        svu.fit_sh(*fit_samples(2003, 40), 10)
    with pytest.raises(svu.SvuError, match=r"degree must be in \[1, 9\], got 10"):
        svu.preset("default", degree=10)


@pytest.mark.few(2)
@pytest.mark.parametrize("base", ["default", "paper"])
@pytest.mark.parametrize("power", [-8, -3, 2])
@pytest.mark.parametrize(
    "views, kind", [(7, "spread"), (40, "grazing"), (130, "spread"), (40, "identical")]
)
def test_any_regularizer(views, kind, power, base):
    assert_fit(*fit_samples(3001, views, kind), 6, 10.0**power, base)


@pytest.mark.few(3)
@pytest.mark.parametrize("views", [20, 130])
@pytest.mark.parametrize("change", [
    lambda f: 1e-6 * f, lambda f: 1e6 * f, lambda f: 0 * f, lambda f: 0 * f + 1,
    *(lambda f, peak=peak: np.where(np.arange(f.shape[1])[:, None] == 3, peak, f)
      for peak in (4096.0, 1e5, 1e9)),
], ids=["1e-6", "1e6", "black", "constant", "4096", "1e5", "1e9"])  # fmt: skip
def test_any_radiance(change, views):
    d, w, f = fit_samples(4001, views)
    assert_fit(d, w, change(f).astype(np.float32))

"""Comparison of the posterior of unseen texels with the prior."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
from oracle.posterior import Prior


def blind(estimate: Any) -> Any:
    """Return the estimate, had no photograph shown anything."""
    count = estimate.texels.count
    posterior = replace(estimate.posterior, observed=np.zeros(count, bool))
    return replace(
        estimate, posterior=posterior, coverage=mi.UInt32(np.zeros(count, np.uint32)),
        seen_per_view=0 * estimate.seen_per_view,
    )  # fmt: skip


def assert_unseen_have_the_prior(posterior: Any, weights: np.ndarray) -> None:
    """Hold everything that is said of unseen texels against the prior, in double precision.

    Args:
        posterior: on a grid whose nodes are all there is; entropy is a part of log n.
        weights: what its prior was asked for with, of cells or of roughnesses.
    """
    names, unseen = list(posterior.axes), ~posterior.observed
    truth = Prior.of(weights, list(posterior.axes.values()))
    assert unseen.any()
    np.testing.assert_allclose(posterior.prior, truth.p, rtol=1e-6)
    p = np.array(posterior.probabilities, np.float64)[unseen]
    p = p.reshape(unseen.sum(), *truth.p.shape, posterior.channels)
    expected = np.broadcast_to(truth.p[..., None], p.shape)
    np.testing.assert_allclose(p, expected, rtol=1e-6)
    np.testing.assert_allclose(np.array(posterior.entropy())[unseen], truth.entropy(), rtol=1e-6)
    drawn, count = posterior.draw(1500, seed=3), 1500 * int(unseen.sum())
    for axis, name in enumerate(names):
        marginal, nodes = truth.marginal(axis), truth.nodes[axis]
        for result, value in (
            (posterior.mean(name), truth.mean(axis)), (posterior.sd(name), truth.sd(axis)),
        ):  # fmt: skip
            np.testing.assert_allclose(np.array(result)[unseen], value, rtol=1e-5, atol=1e-7)
        own = np.array(posterior.marginal(name))[unseen]
        own = own.reshape(len(own), len(nodes), -1)
        np.testing.assert_allclose(own, np.broadcast_to(marginal[:, None], own.shape), rtol=1e-6)
        low, high = (np.array(end)[unseen] for end in posterior.interval(name))
        allowed = nodes[marginal > 0]
        assert (low <= allowed[0]).all() and (high >= allowed[-1]).all()
        assert ((low > nodes[0]) == (marginal[0] == 0)).all()  # no further than that
        values = np.array(drawn[name])[:, unseen]
        values = values.reshape(*values.shape[:2], -1)[..., 0]
        for node, q in zip(nodes, marginal, strict=True):
            share = np.isclose(values, node, atol=1e-6).mean()
            assert abs(share - q) <= 5 * np.sqrt(q * (1 - q) / count) + 1e-12
    best = [np.array(posterior.map()[name])[unseen] for name in names]
    cells = [
        np.abs(np.asarray(axis)[:, None] - x.reshape(len(x), -1)[:, 0]).argmin(axis=0)
        for axis, x in zip(truth.nodes, best, strict=True)
    ]
    assert (truth.p[tuple(cells)] >= (1 - 1e-5) * truth.p.max()).all()
    if np.ptp(truth.p) <= 1e-5 * truth.p.max():  # none is more likely: the middle
        for cell, nodes in zip(cells, truth.nodes, strict=True):
            assert (cell == len(nodes) // 2).all()
    p, q = (np.maximum(x, 1e-30) for x in (truth.p, np.array(posterior.probabilities)[0]))
    if posterior.channels == 1:
        divergence = np.array(posterior.kl(posterior))[unseen][:, 0]
        exact = (truth.p * np.log(p / q)).sum()
        np.testing.assert_allclose(divergence, exact, rtol=1e-4, atol=1e-5)

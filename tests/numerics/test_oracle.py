"""The measure itself: an oracle that stands alone, and bounds that hold."""

from __future__ import annotations

import ast
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import posterior as oracle
from oracle.rounding import exact_entropy


def test_the_oracle_uses_nothing_of_svu_mi(root):
    files = [ast.parse(path.read_text()) for path in (root / "tests" / "oracle").glob("*.py")]
    used = {
        name.split(".")[0]
        for node in itertools.chain.from_iterable(map(ast.walk, files))
        for name in (
            [a.name for a in node.names] if isinstance(node, ast.Import)
            else [node.module] if isinstance(node, ast.ImportFrom) else []
        )
    }  # fmt: skip
    standard = {"__future__", "collections", "dataclasses", "itertools", "math", "typing"}
    assert used <= {*standard, "numpy", "scipy", "oracle"}


@pytest.mark.parametrize("channels", [1, 3])
@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), size=st.sampled_from([0.1, 3.0, 40.0]),
       error=st.sampled_from([1e-6, 1e-3, 0.1]))  # fmt: skip
def test_entropy_error_is_bounded_by_energy_error(channels, seed, size, error):
    rng = np.random.default_rng(seed)
    x = [size * rng.exponential(size=(5, 4)) for _ in range(channels)]
    dx = [np.full((5, 4), error) for _ in range(channels)]
    exact = exact_entropy(x, dx)
    for _ in range(5):
        moved = [a + error * rng.choice([-1, 1], a.shape) for a in x]
        p = oracle.of_channels(oracle.joint(moved), (5, 4))
        assert abs(oracle.mean_entropy(p) - exact.entropy) <= exact.bound


def test_bounds_are_small_without_uncertainty():
    assert exact_entropy([np.zeros((8, 8))], [np.zeros((8, 8))]).entropy == pytest.approx(1)
    sharp = np.full((8, 8), 1e6)
    sharp[2, 3] = 0
    for energies in (np.zeros((8, 8)), sharp):
        assert exact_entropy([energies], [np.zeros((8, 8))]).bound < 1e-6

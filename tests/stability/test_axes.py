"""The quick cases of every axis that ``python -m extremes`` drives to its ends."""

from __future__ import annotations

import numpy as np
import pytest
from extremes import run as stability
from extremes.cases import Axis, Found, refused
from extremes.run import measure, stability_table

from svu_mi.progress import Progress

AXES = {axis.name: axis for axis in stability.AXES}
ELSEWHERE = ("cameras", "distance from the origin", "degree of a fit", "exposure")  # test_limits.py
LONG = (
    "light", "noise that is estimated", "size of the mesh", "faces", "paint",
    "radiance of statistics", "grids of statistics", "filtered light", "views of a fit", "rotation",
    "lambda", "rules of the spectrum",
)  # fmt: skip


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=[pytest.mark.slow] if name in LONG else [])
    for name in AXES if name not in ELSEWHERE
])  # fmt: skip
def test_every_error_is_within_its_bound(name, tmp_path):
    row = measure(AXES[name], tmp_path, quick=True)
    assert not row.failed, row


def fixed(found) -> Axis:
    def cases(*_):
        yield "good", lambda: Found(np.array([1e-9]), 1e-8, np.array([0.0, 1.0]))
        yield "case", found

    return Axis("axis", "a to b", "this with that", cases)


def fails() -> Found:
    raise ValueError("no luck")


@pytest.mark.parametrize(
    "found, nan, ratio",
    [
        (lambda: Found(np.array([0.0, np.nan]), 1.0, np.zeros(0)), 1, np.inf),
        (lambda: Found(np.array([0.0]), 1.0, np.array([0.5, np.nan])), 1, 0.1),
        (lambda: Found(np.array([0.0]), 1.0, np.array([1.0 + 1e-12])), 0, 0.1),
        (lambda: Found(np.array([0.0]), 1.0, np.array([-1e-30])), 0, 0.1),
        (lambda: Found(np.array([3e-3, 2e-3]), np.array([1.0, 1e-3]), np.zeros(0)), 0, 2.0),
        (fails, 0, np.inf),
        (lambda: refused(lambda: None), 0, np.inf),
    ],
)
def test_what_is_wrong_is_seen(found, nan, ratio, tmp_path):
    row = measure(fixed(found), tmp_path, quick=True)
    assert len(row.failed) == 1
    assert row.failed[0].startswith("case")
    assert row.nan == nan
    assert row.ratio == pytest.approx(ratio)
    assert row.cases == 2


def test_the_record_becomes_a_table(tmp_path, monkeypatch):
    axes = (fixed(lambda: Found(np.zeros(0), 0.0, np.array([0.25]))), fixed(fails))
    monkeypatch.setattr(stability, "AXES", axes)
    record = stability.run_stability(tmp_path / "new", Progress(), quick=True)
    assert not record["stable"]
    assert [len(row["failed"]) for row in record["rows"]] == [0, 1]
    text = stability_table(record)
    assert "| axis | a to b | this with that | 2 | 1e-09 | 1e-08 | 0.1 | 0 | 0 | 1 |" in text
    assert "* axis: case: ValueError: no luck" in text

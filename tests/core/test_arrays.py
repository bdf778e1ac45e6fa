"""Conversion of NumPy arrays to Dr.Jit."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from svu_mi.core.arrays import LARGE, to_drjit


@pytest.mark.parametrize("count", [300, LARGE // 4])
def test_what_is_written_later_does_not_show(count):
    """This includes writes before a busy Dr.Jit has copied the array."""
    start = (mi.UInt32(0), dr.zeros(mi.Float, 1 << 16))
    last = dr.opaque(mi.UInt32, 3000)
    dr.eval(dr.while_loop(start, lambda i, _: i < last, lambda i, x: (i + 1, x + 1))[1])
    values = np.full(count, 3, np.float32)
    copied = to_drjit(mi.Float, values)
    values[:] = 9
    assert (copied.numpy() == 3).all()

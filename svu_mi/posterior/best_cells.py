"""The most probable cell of every texel, without the probabilities of all."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.interop import owned
from svu_mi.posterior.calibrated_kernel import cleared
from svu_mi.posterior.problem import Problem
from svu_mi.posterior.walk import Node, Walker


def best_cells(problem: Problem, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the most probable cell of texels, without the masses of all.

    Args:
        problem: of S texels.
        chosen: (t,) int64, which of them.

    Returns:
        (t,) int64, which of the R M cells of all but base colour has most mass, the first of
        several; and (t, C) int64, which of K is that of every channel's base colour, given that.
    """
    walker, nodes = Walker(problem, owned(mi.UInt32, chosen)), problem.nodes
    _, of_column, _ = problem.shape
    columns = dr.opaque(mi.UInt32, of_column)

    def visit(node: Node, masses: Any, *state: Any) -> tuple[Any, ...]:
        column = dr.gather(mi.UInt32, nodes.column, node.column)
        masses[column] = masses[column] + node.weight
        return (masses, *state)

    def row_ends(row: Any, masses: Any, most: Any, best: Any) -> tuple[Any, ...]:
        first = dr.gather(mi.UInt32, nodes.row, row) * columns
        end = dr.select(dr.gather(mi.UInt32, nodes.last, row) > 0, columns, 0)

        def compare(k: Any, masses: Any, most: Any, best: Any) -> tuple[Any, ...]:
            mass = masses[k]
            masses[k] = mi.Float(0)
            best = dr.select(mass > most, first + k, best)
            return k + 1, masses, dr.maximum(most, mass), best

        return dr.while_loop(
            (mi.UInt32(0), masses, most, best), lambda k, *_: k < end, compare
        )[1:]  # fmt: skip

    zero = dr.zeros(mi.Float, len(chosen))
    _, _, best = walker.over_rows(
        mi.UInt32(0), dr.opaque(mi.UInt32, problem.roughness.count), visit, row_ends,
        (cleared(of_column), zero, mi.UInt32(zero)),
    )  # fmt: skip
    dr.eval(best)
    return best.numpy().astype(np.int64), _best_colors(walker, best)


def _best_colors(walker: Walker, best: Any) -> np.ndarray:
    """The most probable cell of every channel's base colour, (t, C) int64, given that of all
    other parameters, (t,) UInt32."""
    problem, nodes = walker.problem, walker.nodes
    _, of_column, of_color = problem.shape
    row, wanted = best // of_column, best % of_column

    def visit(node: Node, *masses: Any) -> tuple[Any, ...]:
        here = dr.gather(mi.UInt32, nodes.column, node.column) == wanted
        weight = dr.select(here, node.weight, 0)
        parts = [part for color in node.colors for part in color.cells]
        return tuple(dr.fma(weight, part, old) for part, old in zip(parts, masses, strict=True))

    zeros = [dr.zeros(mi.Float, dr.width(best)) for _ in range(problem.factors.channels * of_color)]
    begin, end = (dr.gather(mi.UInt32, nodes.first, row + k) for k in (0, 1))
    masses = walker.over_rows(begin, end, visit, lambda _, *masses: masses, tuple(zeros))
    dr.eval(masses)
    table = np.stack([mass.numpy() for mass in masses], axis=1)
    return table.reshape(len(table), -1, of_color).argmax(axis=2)

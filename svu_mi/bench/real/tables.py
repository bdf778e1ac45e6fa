"""What was found of photographs that were left out, as Markdown tables."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from svu_mi.bench.experiment import Record
from svu_mi.bench.real.score import LEVELS
from svu_mi.bench.text import Column, columns, digits, seconds


def _held(level: float) -> Callable[[tuple[str, Record]], float | None]:
    return lambda row: row[1]["holds"].get(str(level))


def _quantile(row: Record, q: float) -> float | None:
    return float(np.quantile(row["views"], q)) if row["views"] else None


PREDICTED = (
    Column("prediction", lambda row: row[0]),
    Column("photographs", lambda row: row[1]["scored"]),
    Column("R^2", lambda row: row[1]["r2"], digits(3)),
    Column("facing the camera", lambda row: row[1]["facing"], digits(3)),
    Column("steeper than 45 degrees", lambda row: row[1]["steep"], digits(3)),
    Column("of photographs: median", lambda row: _quantile(row[1], 0.5), digits(3)),
    Column("worst tenth below", lambda row: _quantile(row[1], 0.1), digits(3)),
    Column("PSNR (dB)", lambda row: row[1]["psnr"], digits(1)),
    *(Column(f"{100 * level:g} % intervals hold", _held(level), digits(3)) for level in LEVELS),
    Column("time", lambda row: row[1]["seconds"], seconds),
)  # fmt: skip


def real_tables(record: Record) -> list[str]:
    """Return the tables of a record.

    Args:
        record: of ``svu bench real``.
    """
    parts = []
    for cell in record["cells"]:
        parts += [_about(cell), columns(PREDICTED, list(cell["rows"].items())), _made_of(cell)]
    return parts


def _about(cell: Record) -> str:
    odd, (low, high) = cell["odd"], cell["gains"]
    fit = f"{len(odd)} of them do not fit the others: {', '.join(odd)}" if odd else "all fit"
    return (
        f"{cell['cell']}: {cell['left_out']} of {cell['photographs']} photographs are left out and "
        f"predicted from the others ({fit}; gains {low:.2f} to {high:.2f}), at {cell['texels']} "
        f"texels that are seen well enough. Estimated in {seconds(cell['seconds'])}. Gains of a "
        "photograph that was left out are from half of its texels, scores from the other half; "
        "pixels that are clipped are not scored, nor photographs that show few texels."
    )


def _made_of(cell: Record) -> str:
    found = cell["metallic"]
    return (
        f"Of {found['seen']} texels seen by ten photographs or more, {found['metallic']:.1%} are "
        f"metallic, {found['open']:.1%} are open, {found['dielectric']:.1%} are not metallic (90 % "
        f"intervals above, across and below .5); {found['reaches 1']:.1%} of the intervals reach "
        "beyond .9."
    )

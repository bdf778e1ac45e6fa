"""What the recovery benchmark found, as Markdown tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import numpy as np

from svu_mi.bench.experiment import Record
from svu_mi.bench.recovery.rows import ROWS, Row
from svu_mi.bench.text import Column, columns, digits, seconds, table
from svu_mi.parameters import NAMES

Line = tuple[str, Sequence[Record]]  # a label, and the records that its figures are means of


def _mean_at(*path: str) -> Callable[[Line], float | None]:
    """Return what takes the mean of a figure that records hold at a path of names.

    Where no record has it, there is none.
    """

    def mean(line: Line) -> float | None:
        values: list[Any] = [reduce(_entry, path, record) for record in line[1]]
        found = [value for value in values if value is not None]
        return float(np.mean(found)) if found else None

    return mean


def _entry(record: Any, name: str) -> Any:
    return None if record is None else record.get(name)


MEANS = (
    Column("recovery", lambda line: line[0]),
    *(Column(name.replace("_", " ").replace("color", "colour"), _mean_at("psnr", name),
             digits(2)) for name in NAMES),
    Column("average", _mean_at("psnr", "average"), digits(2)),
    Column("average, hardly seen", _mean_at("psnr_hardly_seen", "average"), digits(2)),
    Column("relit, HDR", _mean_at("relit", "psnr_hdr"), digits(2)),
    Column("relit, LDR", _mean_at("relit", "psnr_ldr"), digits(2)),
    Column("relit, SSIM", _mean_at("relit", "ssim"), digits(3)),
    Column("time", _mean_at("seconds"), seconds),
    Column("error with entropy, Pearson", _mean_at("entropy_correlation"), digits(2)),
)  # fmt: skip


def recovery_tables(record: Record) -> list[str]:
    """Return the tables of a record.

    Args:
        record: of ``svu bench recovery``.
    """
    cells = record["cells"]
    if not cells:
        return []
    rows = [row for row in ROWS if any(row.label in cell["rows"] for cell in cells)]
    return [
        "PSNR of textures over the texels that a photograph shows, in dB; relit: pictures under "
        "another light with recovered and with true textures, pixels of the object only, PSNR of "
        "radiance and of tone-mapped values. Times are warm, by the clock. Direct light.",
        f"{len(cells)} cells (object / light): {', '.join(map(title_of, cells))}; "
        f"{cells[0]['views']} photographs.",
        columns(MEANS, _lines(cells, rows)),
        _by_cell(cells, rows),
    ]


def title_of(cell: Record) -> str:
    """Return ``object / light`` of a cell."""
    return f"{cell['object']} / {cell['light']}"


def _lines(cells: list[Record], rows: list[Row]) -> list[Line]:
    """Means over cells; a row that not all cells have says how many it is the mean of."""
    lines: list[Line] = []
    for row in rows:
        found = [cell["rows"][row.label] for cell in cells if row.label in cell["rows"]]
        label = row.label if len(found) == len(cells) else f"{row.label} ({len(found)} cells)"
        lines.append((label, found))
    ceiling = [{"relit": cell["truth_relit"]} for cell in cells]
    return [*lines, ("true textures at this resolution", ceiling)]


def _by_cell(cells: list[Record], rows: list[Row]) -> str:
    """Average PSNR and time of every cell and row."""
    lines = []
    for cell in cells:
        found = [cell["rows"].get(row.label) for row in rows]
        lines.append([title_of(cell), *("" if one is None else f"{one['psnr']['average']:.2f}, "
                              f"{seconds(one['seconds'])}" for one in found)])  # fmt: skip
    return table(("cell", *(row.label for row in rows)), lines)

"""What ``run_recovery`` found, as Markdown tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from svu_mi.bench.bars import bar_table
from svu_mi.bench.failures import left_out
from svu_mi.bench.recovery.bars import gain, paired
from svu_mi.bench.recovery.rows import PATH, PATH_SHARING, ROWS, SH, SH_SHARING, Row
from svu_mi.bench.text import number, seconds, table
from svu_mi.parameters import NAMES

Record = dict[str, Any]
TITLES = {
    "even": "Photographs from everywhere",
    "repeated": "Sharing: few materials that repeat, photographs mostly from one side",
    "varied": "Sharing: nothing repeats, photographs mostly from one side",
}


def recovery_tables(record: Record) -> str:
    """Return the tables of a record.

    Args:
        record: what ``run_recovery`` returns.
    """
    parts = [_heading(record)]
    if record["bars"]:
        parts += ["## Bars", _note(record), bar_table(record["bars"])]
    for group, title in TITLES.items():
        cells = [cell for cell in record["cells"] if cell["group"] == group]
        if cells:
            parts += [f"## {title}", *_group(group, cells)]
    if record["costs"]:
        parts += ["## Steps", *_costs(record["costs"])]
    parts += left_out("Left out of recovery", record)
    return "\n\n".join(parts)


def _heading(record: Record) -> str:
    text = (
        "PSNR of textures over the texels that a photograph shows, in dB; relit: pictures under "
        "another light with recovered and with true textures, pixels of the object only, PSNR of "
        "radiance and of tone-mapped values. Times are warm, by the clock. Direct light."
    )
    if record["versions"] > 1:
        text += f" Figures of {record['versions']} versions of the code."
    return text


def _note(record: Record) -> str:
    if record["quick"]:
        return "Quick sizes, which the bars are not meant for; times are with compilation."
    return "PSNR: means over the cells that have both rows. Times: medians over cells of ratios."


def _group(group: str, cells: list[Record]) -> list[str]:
    rows = [row for row in ROWS if any(row.label in cell["rows"] for cell in cells)]
    names = ", ".join(f"{cell['object']} / {cell['light']}" for cell in cells)
    parts = [
        f"{len(cells)} cells (object / light): {names}; {cells[0]['views']} photographs.",
        _means(cells, rows),
    ]
    if group != "even":
        parts.append(_gains(group, cells))
    return [*parts, _by_cell(cells, rows)]


def _means(cells: list[Record], rows: list[Row]) -> str:
    """Means over cells; a row that not all cells have says how many it is the mean of."""
    lines = []
    for row in rows:
        found = [cell["rows"][row.label] for cell in cells if row.label in cell["rows"]]
        label = row.label if len(found) == len(cells) else f"{row.label} ({len(found)} cells)"
        poor = [one["psnr_hardly_seen"]["average"] for one in found if one["psnr_hardly_seen"]]
        lines.append([
            label, *(number(_mean(found, lambda r, n=name: r["psnr"][n])) for name in NAMES),  # type: ignore[misc]
            number(_mean(found, lambda r: r["psnr"]["average"])),
            number(float(np.mean(poor)) if poor else None),
            *(number(_mean(found, lambda r, n=name: r["relit"][n]), digits)  # type: ignore[misc]
              for name, digits in (("psnr_hdr", 2), ("psnr_ldr", 2), ("ssim", 3))),
            seconds(_mean(found, lambda r: r["seconds"])),
            number(_mean(found, lambda r: r["entropy_correlation"])),
        ])  # fmt: skip
    ceiling = [cell["truth_relit"] for cell in cells]
    lines.append([
        "true textures at this resolution", "", "", "", "", "",
        *(number(_mean(ceiling, lambda r, n=name: r[n]), digits)  # type: ignore[misc]
          for name, digits in (("psnr_hdr", 2), ("psnr_ldr", 2), ("ssim", 3))), "", "",
    ])  # fmt: skip
    heads = ("recovery", "base colour", "roughness", "metallic", "average", "average, hardly seen",
             "relit, HDR", "relit, LDR", "relit, SSIM", "time",
             "error with entropy, Pearson")  # fmt: skip
    return table(heads, lines)


def _gains(group: str, cells: list[Record]) -> str:
    """What sharing gains, per cell."""
    pairs = ((SH_SHARING, SH), (PATH_SHARING, PATH))
    lines = []
    for cell in cells:
        line: list[str] = [f"{cell['object']} / {cell['light']}", f"{cell['hardly_seen']:,}"]
        for row, base in pairs:
            found = gain([cell], group, row, base)
            hardly = paired([cell], group, row, base, _hardly)
            line += [_signed(found[0]) if found else "",
                     _signed(hardly[0][0] - hardly[0][1]) if hardly else ""]  # fmt: skip
        lines.append(line)
    heads = ["cell", "texels hardly seen"]
    for row, base in pairs:
        heads += [f"{row.label} over {base.label}", "hardly seen"]
    return table(heads, lines)


def _hardly(row: Record) -> float:
    found = row["psnr_hardly_seen"]
    return found["average"] if found else float("nan")


def _signed(value: float) -> str:
    return "" if value != value else f"{value:+.2f}"


def _by_cell(cells: list[Record], rows: list[Row]) -> str:
    """Average PSNR and time of every cell and row."""
    lines = []
    for cell in cells:
        found = [cell["rows"].get(row.label) for row in rows]
        name = f"{cell['object']} / {cell['light']}"
        lines.append([name, *("" if one is None else f"{one['psnr']['average']:.2f}, "
                              f"{seconds(one['seconds'])}" for one in found)])  # fmt: skip
    return table(("cell", *(row.label for row in rows)), lines)


def _costs(costs: Record) -> list[str]:
    shared = costs["sharing"]
    steps = [
        *([f"path, and with sharing ({name})",
           f"{one['pixels']:,} pixels, {one['spp']} paths each; {one['part']:+.1%}",
           f"{seconds(one['seconds'])}, {seconds(one['seconds_shared'])}"]
          for name, one in shared.items()),
        *([f"sharing ({name}) alone", f"{one['part_alone']:.1%} of a path step",
           seconds(one["alone"])] for name, one in shared.items()),
        *(["SH (ours)", f"{one['views']} views, {one['texels']:,} texels seen",
           seconds(one["seconds"])] for one in costs["views"]),
    ]  # fmt: skip
    runs = [
        [method, one["steps"], one["compiled"], number(one["resident"], 0),
         "" if one["grown"] is None else f"{one['grown']:+.1f}", seconds(one["seconds"])]
        for method, one in costs["long"].items()
    ]  # fmt: skip
    parts = [
        f"{costs['cell']}. One step, loss to gradients, median; what sharing adds is a median of "
        "pairs.",
        table(("step", "of", "time"), steps),
        table(("long run", "steps", "kernels compiled after the start", "resident MiB", "growth",
               "time per step"), runs),
    ]  # fmt: skip
    if costs["cold"]:
        cold = [[label, seconds(one["seconds"]), one["compiled"], seconds(one["process_seconds"])]
                for label, one in costs["cold"].items()]  # fmt: skip
        heads = ("first run, empty kernel cache", "recovery", "kernels compiled",
                 "with start, imports and loading")  # fmt: skip
        parts.append(table(heads, cold))
    return parts


def _mean(records: list[Record], value: Callable[[Record], float]) -> float:
    return float(np.mean([value(record) for record in records]))

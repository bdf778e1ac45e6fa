"""Tables, CSV file and pictures of the Stanford-ORB benchmark."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.bench.experiment import Record
from svu_mi.bench.markdown import FAINT, INK, number, page, seconds, table
from svu_mi.bench.orb.orb_metrics import channel_scale
from svu_mi.bench.orb.orb_targets import FIGURES, Target
from svu_mi.capture.image_io import srgb
from svu_mi.core.io.files import replacing
from svu_mi.output.style import save_figure

TASKS = {"light": "Relighting", "view": "New views", "albedo": "Base colour"}
HEADS = {"psnr_hdr": "PSNR-H", "psnr_ldr": "PSNR-L", "ssim": "SSIM", "lpips": "LPIPS"}
DIGITS = {"psnr_hdr": 2, "psnr_ldr": 2, "ssim": 3, "lpips": 3}
GREY = "uniform grey"
MISSING = "-"
# Table 1 of Wiersma et al. (SIGGRAPH 2025), 42 captures: PSNR-H, PSNR-L, SSIM, LPIPS, and seconds
# per capture on an RTX 4090.
PUBLISHED = (
    ("NVDiffRec", 24.319, 31.492, 0.969, 0.036, 142.0),
    ("Mitsuba", 26.601, 34.195, 0.977, 0.032, 52.0),
    ("SH model", 26.525, 33.796, 0.977, 0.029, 5.1),
    ("power spectrum", 24.494, 31.215, 0.971, 0.035, 1.8),
    ("SH, then one epoch of Mitsuba", 26.918, 34.386, 0.978, 0.031, 16.0),
)


def orb_tables(record: Record) -> list[str]:
    """Return the tables of a record of ``svu bench orb``."""
    captures = record["cells"]
    if not captures:
        return []
    parts = [_heading(record)]
    for task, title in TASKS.items():
        parts += [f"## {title}", _means(captures, task)]
    if len(captures) > 1:
        parts += ["## By capture", "PSNR-H and PSNR-L of relighting.", _by_capture(captures)]
    parts += [
        "## Published",
        "Table 1 of the paper, relighting, all 42 captures of the real data set; times on an RTX "
        "4090.",
        _published(),
    ]
    return parts


def orb_lines(record: Record) -> list[str]:
    """Return one line of text per recovery method: its relighting scores."""
    captures = record["cells"]
    labels = dict.fromkeys(label for capture in captures for label, _ in _rows(capture))
    lines = []
    for label in labels:
        rows = [dict(_rows(capture))[label] for capture in captures]
        figures = (f"{HEADS[name]} {_mean(rows, 'light', name)}" for name in FIGURES)
        lines.append(f"{label}: {', '.join(figures)}")
    return lines


def write_csv(path: Path, record: Record) -> None:
    """Write a CSV file with one line per capture, row, task and photograph.

    Raises:
        OutputError: The file cannot be written.
    """
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(("capture", "row", "task", "of_capture", "photograph", *FIGURES))
        for capture in record["cells"]:
            for label, row in _rows(capture):
                for task in TASKS:
                    for one in (row[task] or {"single": ()})["single"]:
                        figures = ("" if one[name] is None else one[name] for name in FIGURES)
                        of = (one["capture"], one["photograph"])
                        writer.writerow((capture["name"], label, task, *of, *figures))


def _rows(capture: Record) -> Iterator[tuple[str, Record]]:
    yield GREY, capture["grey"]
    yield from capture["rows"].items()


def _heading(record: Record) -> str:
    captures = record["cells"]
    first = captures[0]
    count = sum(capture["novel"] for capture in captures)
    text = (
        f"Captures: {len(captures)}; photographs reduced to {first['film']} pixels, "
        f"{first['resolution']} x {first['resolution']} texels. Means and standard deviations over "
        "captures, by the rules of the data set (`svu_mi/bench/orb/orb_metrics.py`). Relighting: "
        f"{count} photographs of the object in other places, each under the light of its place, "
        "with scaled channels. New views: test photographs of the same place, not scaled. Base "
        "colour: compared with the data set, with scaled channels. Depth, normals and shape are "
        "not compared, because geometry is given. Times: recovery, wall clock."
    )
    if all(c["grey"]["light"]["mean"]["lpips"] is None for c in captures):
        text += " LPIPS needs `pip install lpips`."
    if first["rendered"]:
        text = f"**Not the data set: scenes of svu_mi in its layout.** {text}"
    if record["quick"]:
        text += " Quick sizes, smaller than the data set."
    return text


def _means(captures: list[Record], task: str) -> str:
    labels = dict.fromkeys(label for capture in captures for label, _ in _rows(capture))
    names = _figures(task)
    lines = []
    for label in labels:
        rows = [dict(_rows(capture))[label] for capture in captures]
        times = [row["seconds"] for row in rows if "seconds" in row]
        lines.append([label, *(_mean(rows, task, name) for name in names),
                      seconds(float(np.mean(times))) if times else ""])  # fmt: skip
    return table(("recovery", *(HEADS[name] for name in names), "time"), lines)


def _figures(task: str) -> tuple[str, ...]:
    return FIGURES[1:] if task == "albedo" else FIGURES


def _mean(rows: list[Record], task: str, name: str) -> str:
    """Return mean and standard deviation over captures, as in the tables of the data set."""
    values = [row[task]["mean"][name] for row in rows if row[task] is not None]
    if not values or None in values:
        return MISSING
    spread = f" ± {np.std(values):.{DIGITS[name]}f}" if len(values) > 1 else ""
    return number(float(np.mean(values)), DIGITS[name]) + spread


def _by_capture(captures: list[Record]) -> str:
    labels = list(dict.fromkeys(label for capture in captures for label, _ in _rows(capture)))
    lines = []
    for capture in captures:
        rows = dict(_rows(capture))
        cases = [
            f"{rows[label]['light']['mean']['psnr_hdr']:.2f}, "
            f"{rows[label]['light']['mean']['psnr_ldr']:.2f}"
            for label in labels
        ]
        seen = f"{capture['seen'] / capture['texels']:.0%}"
        lines.append([capture["name"], capture["photographs"], seen,
                      number(capture["entropy"], 3), *cases])  # fmt: skip
    heads = ("capture", "photographs", "texels seen", "mean entropy", *labels)
    return table(heads, lines)


def _published() -> str:
    lines = [[name, *(number(x, 3) for x in figures), seconds(time)]
             for name, *figures, time in PUBLISHED]  # fmt: skip
    return table(("method", *HEADS.values(), "time"), lines)


Shown = tuple[str, Target, np.ndarray, dict[str, Any], bool]
WHITE = 0.98  # share of the object's pixels that are not clipped
LARGEST = 0.25  # difference of sRGB values at the upper end of the colour map


def draw_pictures(path: Path, label: str, shown: Sequence[Shown]) -> None:
    """Draw photograph, picture and difference, one row per task.

    Args:
        path: PNG file.
        label: Label of the recovery method.
        shown: Per row: title, target, picture (H, W, 3), scores, and True if channels are scaled.

    Raises:
        OutputError: The file cannot be written.
    """
    figure = page(7.2, 2.6 * len(shown))
    for axes, (title, target, picture, figures, scaled) in zip(
        figure.subplots(len(shown), 3, squeeze=False), shown, strict=True
    ):
        photograph, made = _comparable(target, picture, scaled=scaled)
        difference = np.abs(photograph - made).max(axis=-1)
        axes[0].imshow(photograph)
        axes[1].imshow(made)
        axes[2].imshow(difference, cmap="magma", vmin=0, vmax=LARGEST)
        first = figures["single"][0]
        axes[0].set_title(f"{first['capture']}, {first['photograph']}", fontsize=9, color=INK)
        axes[1].set_title(f"{label}, {title}", fontsize=9, color=INK)
        axes[2].set_title(f"difference; PSNR-L {first['psnr_ldr']:.1f} dB", fontsize=9, color=FAINT)
        for one in axes:
            one.set_axis_off()
    save_figure(figure, path)


def _comparable(
    target: Target, picture: np.ndarray, *, scaled: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return photograph and picture with equal tone mapping, black outside the object."""
    if scaled:
        picture = picture * channel_scale(picture[target.mask], target.photograph[target.mask])
    mask = target.mask[..., None]
    bright = target.photograph[target.mask].max(axis=-1)
    white = max(float(np.quantile(bright, WHITE)), 1e-6)
    first, second = (
        srgb(np.where(mask, np.clip(x / white, 0, 1), 0)) for x in (target.photograph, picture)
    )
    return first, second

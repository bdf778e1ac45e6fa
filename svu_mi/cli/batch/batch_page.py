"""Page and CSV table of a batch, one row per capture."""

import csv
import io
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from svu_mi.cli.batch.capture_list import INDEX, TABLE
from svu_mi.cli.batch.runner import Outcome
from svu_mi.cli.batch.steps import STEPS
from svu_mi.core.io.files import write_text
from svu_mi.output.html import PageImage, embedded_png, write_page

SIDE = 160  # width of a thumbnail in pixels
COLUMNS = ("capture", "seen", "entropy", "known", "seconds", "peak_gb", "problem")


def write_index(output: Path, outcomes: Sequence[Outcome], waiting: int = 0) -> None:
    """Write ``index.html`` and ``index.csv``, each atomically."""
    rows = sorted(outcomes, key=lambda outcome: outcome.name)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for one in rows:
        figures = [f"{one.figures[name]:.4f}" if name in one.figures else ""
                   for name in COLUMNS[1:4]]  # fmt: skip
        peak = f"{one.peak / 1e9:.2f}"
        table.writerow([one.name, *figures, f"{one.seconds:.1f}", peak, one.sentence])
    write_text(output / TABLE, text.getvalue().removesuffix("\n"))
    write_page(
        output / INDEX, "batch.html", rows=[_row(outcome) for outcome in rows],
        count=len(rows), failed=sum(bool(one.sentence) for one in rows), waiting=waiting,
    )  # fmt: skip


def _row(outcome: Outcome) -> dict[str, Any]:
    """Return the cells of a capture on the page."""
    links = {
        name: f"{quote(outcome.name)}/{step.output}{'' if '.' in step.output else '/'}"
        for name, step in STEPS.items() if name in outcome.done
    }  # fmt: skip
    picture = thumbnail(outcome.folder) if "entropy" in links else None
    return {"links": links, "picture": picture, "outcome": outcome}


def thumbnail(folder: Path) -> PageImage | None:
    """Return a thumbnail of a capture's ``overview.png``; None if that file is missing."""
    path = folder / "entropy" / "overview.png"
    try:
        return _draw_thumbnail(path, path.stat().st_mtime_ns)
    except OSError:
        return None


@cache
def _draw_thumbnail(path: Path, _time: int) -> PageImage:
    """Return a thumbnail; cached, because each finished capture rewrites the whole page."""
    from PIL import Image

    with Image.open(path) as image:
        return embedded_png(np.asarray(image.convert("RGB"), np.float32) / 255, 2 * SIDE)

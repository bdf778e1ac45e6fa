"""Files of ``svu relight``: renders under another light and their standard deviations."""

import os
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import svu_mi
from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import capture_key
from svu_mi.capture.image_io import quantized
from svu_mi.capture.tonemap import tone_mapped
from svu_mi.core.identifiers import fits_file_name
from svu_mi.core.io.exr import write_exr
from svu_mi.core.io.output_folder import writing
from svu_mi.output import object_views, style
from svu_mi.output.export.asset_images import write_png
from svu_mi.output.run_record import RECORD, RunInfo, inputs_record, write_run
from svu_mi.output.style import VIEWS_COLORMAP, Block, Panel
from svu_mi.recovery.relighting import RelitView

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAGE = "relight.png"
HEADING = "Relit object, with standard deviations"
CELL, BAR = 4.2, 0.4  # inches, of a picture and of its colour bar
ROWS = 6  # views on the page
PLAIN = re.compile(r"\w[\w +-]*")  # view names that can be file names
COLUMNS = 3
DARK = 0.01  # lower bound of the radiance that deviations are divided by, relative to the median
WIDEST = 0.5  # relative standard deviation at the upper end of the colours


def write_relighting(
    capture: Capture, views: Sequence[RelitView], names: Sequence[str],
    folder: str | os.PathLike[str], run: RunInfo | None = None, *, draws: int,
    pictures: bool = True,
) -> None:  # fmt: skip
    """Write pictures, standard deviations, ``relight.png`` and ``run.json``.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    run = run or RunInfo()
    about = {"svu:version": svu_mi.__version__, "svu:draws": draws}
    with writing(folder, "relight", RECORD, capture=capture_key(capture)) as draft:
        files = view_file_names(names)
        write_relit_views(views, files, draft.folder, about)
        if pictures:
            notes = [f"{len(views)} views", f"{draws} draws"]
            write_relit_page(views, names, draft.folder / PAGE, notes)
        record = {
            "inputs": inputs_record(capture), "settings": {"draws": draws},
            "result": {
                "relative_sd": [relative_sd(view) for view in views],
                "views": dict(zip(files, names, strict=True)),
            },
        }  # fmt: skip
        write_run(draft, record, run)


def view_file_names(names: Sequence[str]) -> list[str]:
    """Return file names without suffix: names of the views if valid, else numbers."""
    own = {Path(PAGE).stem, Path(RECORD).stem, *(name.casefold() for name in names)}
    valid = all(PLAIN.fullmatch(name) and fits_file_name(name) for name in names)
    if valid and len(own) == len(names) + 2:
        return list(names)
    return [f"view_{number:04d}" for number in range(len(names))]


def relative_sd(view: RelitView) -> float | None:
    """Return the median relative standard deviation of lit pixels; None if all are black."""
    radiance, sd = view.picture[view.inside].mean(axis=-1), view.sd[view.inside].mean(axis=-1)
    lit = radiance > 0
    return float(np.median(sd[lit] / radiance[lit])) if lit.any() else None


def uncertainty_sentence(views: Sequence[RelitView]) -> str:
    """Return a sentence on the standard deviation of pixels."""
    parts = [part for part in map(relative_sd, views) if part is not None]
    if not parts:
        return "The pictures do not show the object, or it is black."
    median = 100 * float(np.median(parts))
    return (
        f"Relative standard deviation of pixels, median: {median:.1f} %, without the noise of the "
        "samples (--spp)."
    )


def write_relit_views(
    views: Sequence[RelitView], names: Sequence[str], folder: Path,
    attributes: Mapping[str, Any] | None = None,
) -> None:  # fmt: skip
    """Write ``NAME.exr`` (R, G, B, mean.R, ... and sd.R, ..., linear) and ``NAME.png`` per view."""
    for view, name in zip(views, names, strict=True):
        channels = {"RGB": view.picture}
        for kind, image in (("mean", view.mean), ("sd", view.sd)):
            channels |= {f"{kind}.{letter}": image[..., k] for k, letter in enumerate("RGB")}
        write_exr(folder / f"{name}.exr", channels, attributes)
        shown = tone_mapped(view.picture, view.inside)
        write_png(folder / f"{name}.png", quantized(shown), color=True)


def write_relit_page(
    views: Sequence[RelitView], names: Sequence[str], path: Path, notes: Sequence[str]
) -> None:
    """Draw the first six views: picture, standard deviation, relative standard deviation."""
    shown = list(zip(views, names, strict=True))[:ROWS]
    panels: list[Panel] = []
    for view, name in shown:
        window = object_views.object_window(view.inside)
        sd = np.where(view.inside, view.sd.mean(axis=-1), np.nan)
        radiance = np.where(view.inside, view.picture.mean(axis=-1), np.nan)
        top = float(f"{np.nanpercentile(sd, 99):.1g}") if view.inside.any() else 1.0
        picture = tone_mapped(view.picture, view.inside)
        relative = sd / np.maximum(radiance, DARK * float(np.nanmedian(radiance)))
        panels += [
            (name, partial(style.draw_image, image=object_views.crop(picture, window))),
            ("Standard deviation", partial(
                _scaled, values=object_views.crop(sd, window), limits=(0, max(top, 1e-6)))),
            ("Relative to the picture", partial(
                _scaled, values=object_views.crop(relative, window), limits=(0, WIDEST))),
        ]  # fmt: skip
    height = (CELL + BAR) * len(shown) + 1.45
    block = Block(
        panels=panels, shape=(len(shown), COLUMNS),
        box=(0.01, 0.99, 0.5 / height, 1 - 1.25 / height), space=(0.05, 0.28), anchor="NW",
    )  # fmt: skip
    style.write_page(path, (CELL * COLUMNS, height), HEADING, notes, [block])


def _scaled(axes: "Axes", values: np.ndarray, limits: tuple[float, float]) -> None:
    drawn = axes.imshow(values, cmap=VIEWS_COLORMAP, vmin=limits[0], vmax=limits[1])
    style.frame_map(axes)
    style.color_bar(axes, drawn, "", ticks=np.linspace(*limits, 3).tolist())

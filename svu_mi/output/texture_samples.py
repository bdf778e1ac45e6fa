"""Posterior samples of recovered textures: files and overview page."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.tonemap import ObjectView, object_only_scene, srgb
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.core.io.files import prepare_folder
from svu_mi.errors import CaptureError
from svu_mi.geometry.texels import Texels
from svu_mi.output import style
from svu_mi.output.estimate_arrays import label_of
from svu_mi.output.panels import draw_look, fully_seen, map_colors
from svu_mi.output.style import GREY, Block, Panel
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.recovery_result import Recovery
from svu_mi.recovery.svbrdf_textures import Textures

FOLDER, SHEET = "draws", "draws.png"
SHOWN = 6  # samples on the page
CELL = 2.4  # inches
HEADING = "Textures that explain the photographs about equally well"


def write_draws(
    draws: Iterator[Textures], folder: Path, attributes: Mapping[str, Any] | None = None
) -> list[Textures]:
    """Write ``draws/draw_000.exr`` and so on in half precision; return the first six draws.

    Channels are ``base_color.R`` (.G, .B), ``roughness`` and ``metallic``, all in [0, 1].
    """
    place, first = folder / FOLDER, []
    prepare_folder(place)
    for number, draw in enumerate(draws):
        channels = {
            key: np.array(draw[name], np.float32)[..., k]
            for name in NAMES for k, key in enumerate(_channels(name))
        }  # fmt: skip
        write_exr(place / f"draw_{number:03d}.exr", channels, attributes, half=True)
        if number < SHOWN:
            first.append(draw)
    return first


def find_draws(folder: Path) -> list[Path]:
    """Return the files of ``write_draws`` in order; raise ``CaptureError`` without any."""
    files = sorted((folder / FOLDER).glob("draw_*.exr"))
    if not files:
        raise CaptureError(
            f"{folder}: has no draws of the textures; svu recover --draws 16 writes some."
        )
    return files


def read_draws(files: Sequence[Path]) -> Iterator[Textures]:
    """Yield the textures in files of ``write_draws``; raise ``CaptureError`` for a damaged file."""
    for path in files:
        channels = read_exr(path)
        missing = [key for name in NAMES for key in _channels(name) if key not in channels]
        if missing:
            raise CaptureError(f"{path}: no channel {missing[0]}; svu recover --draws writes it.")
        yield Textures.of({
            name: np.clip(np.stack([channels[key] for key in _channels(name)], axis=-1), 0, 1)
            for name in NAMES
        })  # fmt: skip


def write_sheet(
    capture: Capture, recovery: Recovery, draws: Sequence[Textures], path: Path, view: int
) -> None:
    """Draw recovered textures and samples on the object, one row per parameter."""
    columns = [recovery.textures, *draws]
    look = ObjectView.at(object_only_scene(capture), capture.sensors[view])
    panels: list[Panel] = []
    for name in NAMES:
        for number, textures in enumerate(columns):
            title = label_of(name).capitalize() if number == 0 else f"draw {number - 1}"
            shown = texture_colors(recovery.texels, textures, name)
            panels.append((title, partial(draw_look, look=look, colors=shown)))
    height = CELL * len(NAMES) + 1.3
    block = Block(
        panels=panels, shape=(len(NAMES), len(columns)), box=(0.01, 0.99, 0.01, 1 - 1.15 / height),
        space=(0.04, 0.14), anchor="NW",
    )  # fmt: skip
    style.write_page(
        path,
        (CELL * len(columns), height),
        HEADING,
        [style.photograph_title(capture.names[view])],
        [block],
    )


def texture_colors(texels: Texels, textures: Textures, name: str) -> np.ndarray:
    """Return a parameter as screen colours (H, W, 3)."""
    if CHANNELS[name] > 1:
        return srgb(np.clip(np.array(textures[name], np.float32), 0, 1))
    return map_colors(fully_seen(texels), textures.at(texels, name), colormap=GREY)


def _channels(name: str) -> list[str]:
    """Return the channel names of a parameter."""
    return [f"{name}.{letter}" for letter in "RGB"] if CHANNELS[name] > 1 else [name]

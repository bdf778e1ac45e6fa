"""Recovered textures as EXR files, and back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

import svu_mi
from svu_mi.errors import CaptureError
from svu_mi.exr import read_exr, write_exr
from svu_mi.output.manifest import RECORD
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.textures import Textures
from svu_mi.results.reading import require_one_run
from svu_mi.results.settling import settle

FILES = {name: f"{name}.exr" for name in NAMES}


def write_textures(
    textures: Textures,
    folder: str | Path,
    attributes: Mapping[str, str | int | float] | None = None,
    *,
    half: bool = False,
) -> None:
    """Write ``base_color.exr`` (R, G, B), ``roughness.exr`` and ``metallic.exr`` (Y).

    Linear values in [0, 1]; row 0 is v = 0. Texels outside the charts are written as they
    are: ``lay_out`` has filled them with their neighbours.

    Args:
        textures: what to write.
        folder: an existing folder.
        attributes: header entries of each file, such as the settings of the run.
        half: store half floats instead of float32.

    Raises:
        OutputError: a file cannot be written, or a value is NaN or infinite.
    """
    header = {"svu:version": svu_mi.__version__, **(attributes or {})}
    for name, tensor in textures.items():
        channels = "RGB" if CHANNELS[name] == 3 else "Y"
        image = np.array(tensor, np.float32)
        write_exr(Path(folder) / FILES[name], {channels: image}, header, half=half)


def read_textures(folder: str | Path, *, one_run: bool = True) -> Textures:
    """Read the three files that ``write_textures`` writes, from wherever they come.

    Args:
        folder: holds ``base_color.exr``, ``roughness.exr`` and ``metallic.exr``; the latter two
            may also have the one channel R, or three equal ones.
        one_run: refuse files of different runs, as far as they say.

    Raises:
        CaptureError: one is missing, damaged, of another size or has other channels, holds a value
            outside [0, 1], or is of another run than the others.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder; give one with {', '.join(FILES.values())}.")
    settle(folder)
    if one_run:
        require_one_run(folder, list(FILES.values()), RECORD, "recover")
    images = {name: _image(folder / FILES[name], CHANNELS[name]) for name in NAMES}
    sizes = {name: image.shape[:2] for name, image in images.items()}
    if len(set(sizes.values())) > 1:
        words = ", ".join(f"{FILES[name]} {size[1]} x {size[0]}" for name, size in sizes.items())
        raise CaptureError(f"{folder}: the textures differ in size ({words}); resample them.")
    return Textures.of(images)


def _image(path: Path, count: int) -> np.ndarray:
    """Return (H, W, count) float32."""
    channels = read_exr(path)
    wanted = "RGB" if count == 3 else next((c for c in "YR" if c in channels), "Y")
    if not set(wanted) <= set(channels):
        raise CaptureError(
            f"{path}: expected the channels {', '.join(wanted)}, found {', '.join(channels)}."
        )
    if count == 1 and not all(np.array_equal(channels[wanted], c) for c in channels.values()):
        raise CaptureError(f"{path}: a grey texture with unequal channels; export one channel.")
    image = np.stack([channels[letter] for letter in wanted], axis=-1)
    bad = int((~((image >= 0) & (image <= 1))).sum())  # NaN fails both
    if bad:
        raise CaptureError(f"{path}: {bad} values are outside [0, 1] or NaN; clip them.")
    return image

"""Exposure gains of photographs from a list, or from EXIF."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

from PIL import Image

from svu_mi.capture.importers.source import Frame
from svu_mi.capture.importers.source_files import read_lines
from svu_mi.core.io.files import refusing
from svu_mi.core.io.schema import NUMBER, Field, checked
from svu_mi.errors import CaptureError, excerpt

GAIN = {"gain": Field(NUMBER, (), 1e-30, 1e30)}
EXIF, TIME, APERTURE, ISO = 0x8769, 0x829A, 0x829D, 0x8827  # tags of EXIF 2.32


def with_gains(frames: Sequence[Frame], gains: str | Path | None) -> Sequence[Frame]:
    """Return frames with gains from a file, or from EXIF (``exif``); None changes nothing."""
    if gains is None:
        return frames
    return with_exif_gains(frames) if gains == "exif" else with_listed_gains(frames, Path(gains))


def with_listed_gains(frames: Sequence[Frame], path: Path) -> list[Frame]:
    """Return frames with gains from a text file with one line per photograph.

    A line is ``NAME GAIN``, such as ``IMG_0012.jpg 0.25`` or ``left/IMG_0012.jpg 0.25``; empty
    lines and comments (``#``) are ignored.
    """
    gains = {}
    for number, text in read_lines(path, "a list of exposures", "write lines NAME GAIN"):
        with refusing(f"{path}: line {number}: {excerpt(repr(text), 60)}", "write NAME GAIN"):
            name, gain = text.rsplit(maxsplit=1)
            gains[name.strip()] = checked({"gain": float(gain)}, GAIN)["gain"]
    counts = Counter(frame.image.name for frame in frames)
    changed = []
    for frame in frames:
        parts = frame.image.parts
        names = ("/".join(parts[first:]) for first in range(len(parts)))  # longest first
        key = next((name for name in names if name in gains), None)
        if key is None:
            raise CaptureError(
                f"{path}: has no exposure for {frame.image.name}; add a line NAME GAIN."
            )
        if key == frame.image.name and counts[key] > 1:
            raise CaptureError(
                f"{path}: {counts[key]} photographs are named {key}; name them with their "
                f"folder, as {frame.image.parent.name}/{key}."
            )
        changed.append(replace(frame, exposure=gains[key]))
    return changed


def with_exif_gains(frames: Sequence[Frame]) -> list[Frame]:
    """Return frames with gains of time * ISO / aperture^2, relative to the median photograph.

    A missing aperture (lenses without contacts) is assumed to be equal in all photographs.
    """
    gains = [_exif_gain(frame.image) for frame in frames]
    middle = median(gains)
    return [replace(frame, exposure=g / middle) for frame, g in zip(frames, gains, strict=True)]


def _exif_gain(path: Path) -> float:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # relevant damage raises an error
            with Image.open(path) as image:
                tags = image.getexif().get_ifd(EXIF)
        time, aperture = float(tags[TIME]), float(tags.get(APERTURE, 1) or 1)
        speed = tags.get(ISO, 100)
        gain = time * float(speed[0] if isinstance(speed, tuple) else speed) / 100 / aperture**2
        checked({"gain": gain}, GAIN)
    except Exception as error:  # Pillow's parsers raise any type
        raise CaptureError(
            f"{path}: no exposure time in its EXIF data; give exposures as a list with --exposures."
        ) from error
    return gain

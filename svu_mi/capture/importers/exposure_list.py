"""Exposure gains of photographs from a list, or from EXIF."""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

from PIL import Image

from svu_mi.capture.image_formats.image_header import required
from svu_mi.capture.image_io import open_image
from svu_mi.capture.importers.source import Frame
from svu_mi.capture.importers.source_files import read_lines
from svu_mi.core.io.files import refusing
from svu_mi.core.io.schema import NUMBER, Field, checked
from svu_mi.errors import CaptureError, excerpt

GAIN = {"gain": Field(NUMBER, (), 1e-30, 1e30)}
EQUAL = 1.01  # ratio of the largest and the smallest exposure that counts as equal
BRIGHTENED = " If the photographs were brightened afterwards, import with --exposures estimate."
EXIF, TIME, APERTURE, ISO = 0x8769, 0x829A, 0x829D, 0x8827  # tags of EXIF 2.32


def with_gains(
    frames: Sequence[Frame], gains: str | Path | None
) -> tuple[Sequence[Frame], bool, list[str]]:
    """Return frames with their gains, whether these are known, and sentences about them.

    Args:
        frames: frames with the gains of the source.
        gains: ``exif``, ``none`` (1 for all), ``estimate`` (unknown), or a file. None keeps gains
            of the source if there are any, and uses EXIF if all photographs have it; without it,
            gains are 1, and known if all photographs are EXR, HDR or PFM.
    """
    if gains is None and any(frame.exposure != 1 for frame in frames):
        return frames, True, []
    if gains in ("none", "estimate"):
        return [replace(frame, exposure=1.0) for frame in frames], gains == "none", []
    if gains is not None and gains != "exif":
        listed = with_listed_gains(frames, Path(gains))
        return listed, True, _differences(listed, gains)
    try:
        read = with_exif_gains(frames)
    except CaptureError as error:
        if gains is not None:
            raise
        are_radiance = not any(open_image(frame.image).bits for frame in frames)
        some = sum(_has_exposure(frame.taken) for frame in frames)
        note = (
            f"EXIF: exposures of {some} of {len(frames)} photographs are not used, and gains are "
            f"estimated if they differ: {error}"
        )
        return frames, are_radiance, [note] if some else []
    return read, True, [note + BRIGHTENED for note in _differences(read, "EXIF")]


def _differences(frames: Sequence[Frame], source: str | Path) -> list[str]:
    """Return a sentence on how much gains of a ``source`` differ, if they do."""
    each = [frame.exposure for frame in frames]
    ratio = max(each) / min(each)
    if ratio < EQUAL:
        return []
    return [f"{source}: exposures differ by {ratio:.2g} x; pixels are divided by them."]


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
        parts = frame.taken.parts
        names = ("/".join(parts[first:]) for first in range(len(parts)))  # longest first
        key = next((name for name in names if name in gains), None)
        if key is None:
            raise CaptureError(
                f"{path}: has no exposure for {frame.image.name}; add a line NAME GAIN."
            )
        if key == frame.image.name and counts[key] > 1:
            raise CaptureError(
                f"{path}: {counts[key]} photographs are named {key}; name them with their "
                f"folder, as {frame.taken.parent.name}/{key}."
            )
        changed.append(replace(frame, exposure=gains[key]))
    return changed


def with_exif_gains(frames: Sequence[Frame]) -> list[Frame]:
    """Return frames with gains of time * ISO / aperture^2, relative to the median photograph.

    An aperture that is missing everywhere (lenses without contacts) is assumed to be constant.
    """
    gains, apertures = zip(*(_exif_gain(frame.taken) for frame in frames), strict=True)
    if any(apertures) and not all(apertures):
        missing = frames[apertures.index(False)].taken
        raise CaptureError(
            f"{missing}: no aperture in its EXIF data, unlike in others; give exposures as a list "
            "with --exposures."
        )
    middle = median(gains)
    return [replace(frame, exposure=g / middle) for frame, g in zip(frames, gains, strict=True)]


def _exif_gain(path: Path) -> tuple[float, bool]:
    """Return the gain of a photograph, and whether it contains the aperture."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # relevant damage raises an error
            tags = _exposure_tags(path)
        time, aperture = float(tags[TIME]), float(tags.get(APERTURE, 0))
        speed = tags.get(ISO, 100)
        speed = float(speed[0] if isinstance(speed, tuple) else speed)
        gain = time * speed / 100 / (aperture or 1) ** 2
        checked({"gain": gain}, GAIN)
    except Exception as error:  # Pillow's parsers raise any type
        raise CaptureError(
            f"{path}: no exposure time in its EXIF data; remove it, or give exposures as a list "
            "with --exposures."
        ) from error
    return gain, aperture > 0


def _has_exposure(path: Path) -> bool:
    try:
        _exif_gain(path)
    except CaptureError:
        return False
    return True


def _exposure_tags(path: Path) -> Mapping[int, Any]:
    """Return exposure time, aperture and sensitivity of a photograph by EXIF tag."""
    picture = open_image(path)
    if picture.format == "EXR":
        given = picture.header.attributes
        names = {TIME: "expTime", APERTURE: "aperture", ISO: "isoSpeed"}
        return {tag: given[name] for tag, name in names.items() if name in given}
    if picture.format == "RAW":
        shot = required("rawpy", path).imread(str(path)).other
        return {TIME: shot.shutter_speed, APERTURE: shot.aperture, ISO: shot.iso_speed}
    if picture.format == "HEIC":
        image = required("pillow_heif", path).open_heif(path).to_pillow()
    else:
        image = Image.open(path)
    with image:
        return image.getexif().get_ifd(EXIF)

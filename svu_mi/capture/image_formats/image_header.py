"""Properties of an image file, read before its pixels, and packages that read them."""

import contextlib
import importlib
import threading
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from svu_mi.capture.image_formats.color_space import ColorSpace
from svu_mi.core.io.files import may_hold
from svu_mi.errors import CaptureError

ORIENTATION = 0x0112  # EXIF tag
MAX_PIXELS = 2**28  # 16384 x 16384; a damaged header may contain any number

_silent = threading.Lock()  # warnings.catch_warnings is not thread-safe


def required(name: str, path: Path) -> Any:
    """Return a package of the extra ``camera``, which a file needs."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise CaptureError(
            f"{path}: is read by the package {name.replace('_', '-')}; install it with: "
            "pip install 'svu_mi[camera]'."
        ) from error


@contextlib.contextmanager
def without_warnings() -> Iterator[None]:
    """Suppress Pillow's warnings about damaged metadata."""
    with _silent, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@dataclass(frozen=True, kw_only=True)
class ImageHeader:
    """Properties of an image file.

    Attributes:
        size: (width, height) of the stored pixels.
        bits: 8 or 16 for integers, 0 for floating point.
        channels: number of channels in the file, for estimates of memory.
        color: conversion of the values to linear sRGB.
        orientation: EXIF orientation, 1 to 8; 1 if the stored pixels are upright.
        cropped: True if the data window of an EXR differs from its display window.
        attributes: text and numbers of the header of an EXR, by name.
        remarks: clauses about ignored properties, such as "its ICC profile is ignored".
    """

    size: tuple[int, int]
    bits: int = 0
    channels: int = 3
    color: ColorSpace = field(default_factory=ColorSpace)
    orientation: int = 1
    cropped: bool = False
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


def require_plausible(path: Path, size: tuple[int, int], pixel: int) -> None:
    """Raise CaptureError if an image of ``pixel`` bytes per pixel is larger than its file can be.

    It is called before memory for the pixels is allocated.
    """
    width, height = size
    if min(size) < 1 or width * height > MAX_PIXELS:
        raise CaptureError(
            f"{path}: the image is too large ({width} x {height} pixels) or damaged; export it "
            "again."
        )
    if not may_hold(path, width * height * pixel):
        raise CaptureError(
            f"{path}: the header declares {width} x {height} pixels, more than the file can hold; "
            "export it again."
        )

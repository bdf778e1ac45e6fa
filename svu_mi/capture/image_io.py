"""Image files: header, stored channels, and conversion to linear sRGB."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from svu_mi.capture.image_formats.color_space import to_linear_srgb
from svu_mi.capture.image_formats.image_header import ImageHeader, require_plausible
from svu_mi.capture.image_formats.recognition import FORMATS, format_of
from svu_mi.capture.image_formats.recognition import SUFFIXES as SUFFIXES
from svu_mi.capture.tone_curve import SampledCurve, Transfer, linearize
from svu_mi.capture.tone_curve import decoded as decoded
from svu_mi.capture.tone_curve import quantized as quantized
from svu_mi.capture.tone_curve import srgb as srgb
from svu_mi.errors import CaptureError, SvuError

LOST = 0.01  # largest tolerated sum of negative pixels, as a fraction of the image's sum
TURNED = 5  # EXIF orientations from here exchange width and height


@dataclass(frozen=True)
class ImageFile:
    """An image file with its header.

    Attributes:
        path: Path of the file.
        format: Name of the format of its content, such as ``PNG``.
        header: Size, colour space and other properties.
        upright: True to turn pixels as the EXIF orientation requests; False leaves them as stored.
    """

    path: Path
    format: str
    header: ImageHeader
    upright: bool = True

    @property
    def bits(self) -> int:
        """8 or 16 for integer (low dynamic range) files, 0 for floating point."""
        return self.header.bits

    @property
    def orientation(self) -> int:
        """EXIF orientation that is applied."""
        return self.header.orientation if self.upright else 1

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        width, height = self.header.size
        return (height, width) if self.orientation >= TURNED else (width, height)

    def fitted(self, size: tuple[int, int]) -> "ImageFile":
        """Return the file as stored if only so it is as wide or as high as a camera's film."""
        is_wide = self.size[0] > self.size[1]
        wrong = self.size[0] != self.size[1] and size[0] != size[1] and is_wide != (
            size[0] > size[1])  # fmt: skip
        return replace(self, upright=False) if self.orientation >= TURNED and wrong else self

    def planes(self) -> list[np.ndarray]:
        """Read the pixels.

        Returns:
            Float32 planes (H, W): red, green, blue, and alpha if present. Integers are scaled
            to [0, 1] but not decoded; floating-point colours are converted to linear sRGB.
        """
        return [self.scaled(plane) if self.bits else plane for plane in self.stored()]

    def stored(self) -> list[np.ndarray]:
        """Read the pixels like ``planes``, but without conversion of integers."""
        with _readable(self.path):
            values = FORMATS[self.format].read(self.path, self.header)
        planes = values if isinstance(values, list) else [*np.moveaxis(np.atleast_3d(values), 2, 0)]
        if planes[0].shape != self.header.size[::-1]:
            raise CaptureError(f"{self.path}: changed while it was being read; read it again.")
        planes = planes if len(planes) >= 3 else planes[:1] * 3 + planes[1:]
        if not self.bits:
            planes[:3] = to_linear_srgb(planes[:3], self.header.color.matrix)
        return [_turned(plane, self.orientation) for plane in planes]

    def scaled(self, codes: np.ndarray) -> np.ndarray:
        """Return integers as float32 in [0, 1]."""
        return codes.astype(np.float32) / np.float32(np.iinfo(codes.dtype).max)

    def transfer(self, given: Transfer | SampledCurve = "srgb") -> Transfer | SampledCurve:
        """Return the decoding of integers: that of the file, unless another than sRGB is given."""
        return self.header.color.transfer if given == "srgb" else given

    def linear(self) -> list[np.ndarray]:
        """Read red, green and blue as linear sRGB, float32 planes (H, W)."""
        planes = self.planes()[:3]
        if not self.bits:
            return planes
        transfer = self.transfer()
        planes = [linearize(plane, transfer, channel) for channel, plane in enumerate(planes)]
        return to_linear_srgb(planes, self.header.color.matrix)

    def remarks(self) -> list[str]:
        """Return messages about ignored properties, without the name of the file."""
        clauses = list(self.header.remarks)
        if self.path.suffix.lower() not in FORMATS[self.format].suffixes:
            clauses.append(f"{self.format}, despite the suffix; read as {self.format}.")
        if self.header.orientation > 1:
            clauses.append(
                "turned as the EXIF orientation requests. If svu check shows them turned, remove "
                "this tag from the files."
                if self.upright else
                "not turned, although EXIF data request it, because poses refer to the pixels as "
                "stored."
            )  # fmt: skip
        return clauses


def open_image(path: Path) -> ImageFile:
    """Read the header of an image file; raise if it is not readable."""
    if not path.is_file():
        raise CaptureError(f"{path}: no such photograph.")
    if path.suffix.lower() not in SUFFIXES:
        kinds = ", ".join(SUFFIXES)
        raise CaptureError(f"{path}: not a supported image format ({kinds}); convert it to PNG.")
    with _readable(path):
        name = format_of(path) or ("EXR" if path.suffix.lower() == ".exr" else None)
        if name is None:
            raise ValueError("unknown content")
        header = FORMATS[name].open(path)
    require_plausible(path, header.size, header.channels * max(1, header.bits // 8))
    return ImageFile(path, name, header)


def read_planes(path: Path) -> tuple[list[np.ndarray], bool]:
    """Return ``ImageFile.planes``, and True if the file stores integers."""
    picture = open_image(path)
    return picture.planes(), picture.bits > 0


def _turned(plane: np.ndarray, orientation: int) -> np.ndarray:
    """Return a view (H, W) that is upright (EXIF 2.32, 4.6.4)."""
    plane = plane.T if orientation >= TURNED else plane
    plane = plane[:, ::-1] if orientation in (2, 3, 6, 7) else plane
    return plane[::-1] if orientation in (3, 4, 7, 8) else plane


@contextlib.contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn any decoder error into a ``CaptureError`` with the path."""
    try:
        yield
    except CaptureError as error:
        if str(path) in str(error):
            raise
        raise CaptureError(f"{path}: {error}") from error
    except Exception as error:  # decoders raise many types
        raise CaptureError(f"{path}: not a readable image; copy it again, or remove it.") from error


def clamp_negative(
    pixels: np.ndarray, label: str, error: type[SvuError] = CaptureError
) -> tuple[np.ndarray, list[str]]:
    """Set negative pixels, which filters and colour conversions cause, to 0.

    Returns:
        The pixels, and a list with a warning if some were negative.

    Raises:
        SvuError: Type ``error``, if negative pixels reduce the sum by more than 1 %.
    """
    below = pixels < 0
    if not below.any():
        return pixels, []
    count = int(below.any(axis=-1).sum())
    kept = np.where(below, 0, pixels)
    if np.abs(pixels[below]).sum(dtype=np.float64) > LOST * kept.sum(dtype=np.float64):
        raise error(
            f"{label}: {count} pixels are negative and cancel more than {LOST:.0%} of the light; "
            "export the map again."
        )
    return kept, [f"{label}: {count} negative pixels were set to 0."]

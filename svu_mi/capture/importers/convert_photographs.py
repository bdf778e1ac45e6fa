"""Conversion of photographs to linear EXR with the mask as alpha."""

import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from svu_mi.capture.crop import LARGE
from svu_mi.capture.image_formats.color_space import to_linear_srgb
from svu_mi.capture.image_io import ImageFile, open_image
from svu_mi.capture.importers.camera_response import read_response
from svu_mi.capture.importers.resampling import average_area, undistort_planes
from svu_mi.capture.importers.source import Frame
from svu_mi.capture.load_warnings import clipped_where
from svu_mi.capture.match_photographs import masks_of
from svu_mi.capture.photographs import (
    CLIPPED,
    FIRST_STEP,
    IN_MASK,
    LAST_STEP,
    ON_OBJECT,
    SATURATION,
    UNUSABLE,
    read_mask,
)
from svu_mi.capture.quantization import SATURATED, quantization_steps, saturation_radiance
from svu_mi.capture.tone_curve import SampledCurve, linearize
from svu_mi.core.io.exr import write_exr
from svu_mi.errors import OptionError, are, counted

BORDER = 0.9  # share of border pixels in a mask, from which it counts as inverted
CLIPPED_LAYER = "clipped."  # prefix of R, G or B
# Share of the object's pixels from which blacks count as crushed. A mask that is a pixel too large
# includes 1 % of background; grooves and contact shadows are black in any photograph.
CRUSHED = 0.02
PART = 1e-6  # share of a resampled pixel that unusable ones may cover, for rounding


@dataclass(frozen=True, kw_only=True)
class ConvertedPhotograph:
    """Properties of a converted photograph.

    Attributes:
        bits: bits per channel: 8 or 16 for integers; 0 for floats.
        decoded: name of the curve that decodes integers.
        color: name of the colour space that was converted to linear sRGB; empty if none was.
        remarks: clauses about ignored properties.
        saturated: number of saturated pixels, only on the object if there is a mask.
        crushed: share of the object's pixels with a channel of code 0; 0 for floats, and without
            a mask, as the background may be black.
        invalid: number of pixels that are NaN, infinite or negative.
        masked: True if there is a mask; an alpha channel that is opaque everywhere does not count.
        empty: True if the mask is empty.
        inverted: True if the mask covers the border of the photograph, but not all pixels.
    """

    bits: int
    decoded: str
    color: str
    remarks: tuple[str, ...]
    saturated: int
    crushed: float
    invalid: int
    masked: bool
    empty: bool
    inverted: bool


def with_response(frames: Sequence[Frame], response: str | Path | None) -> Sequence[Frame]:
    """Return frames with the response curve of a file; unchanged if ``response`` is None."""
    if response is None:
        return frames
    if not any(open_image(frame.image).bits for frame in frames):
        raise OptionError(
            f"--response: {frames[0].image.name} and all other photographs are linear (EXR, HDR, "
            "PFM); omit this option."
        )
    transfer = read_response(Path(response))
    return [replace(frame, transfer=transfer) for frame in frames]


def convert_photograph(frame: Frame, path: Path, scale: tuple[float, float]) -> ConvertedPhotograph:
    """Write a photograph as EXR: linear R, G, B, and A = 1 on the object if there is a mask.

    A large JPEG that needs no change is copied, with its mask as a PNG next to it: an EXR would be
    ten times larger. Saturated channels become -2; the header contains their smallest radiance.
    Invalid pixels, and averages of saturated and other pixels, become -1.

    Args:
        frame: photograph with its mask; its size is the size of the file.
        path: path of the EXR file.
        scale: scale of width and height, from ``square_pixel_frame``.
    """
    picture = replace(open_image(frame.image), upright=frame.upright)
    plain = frame.lens is None and tuple(scale) == (1.0, 1.0) and frame.transfer == "srgb"
    plain &= picture.format == "JPEG" and picture.bits == 8 and picture.header.orientation == 1
    if plain and math.prod(picture.size) >= LARGE:
        return _copy_jpeg(picture, frame, path)
    planes, bits, transfer = picture.stored(), picture.bits, picture.transfer(frame.transfer)
    mask = _read_mask(frame, picture, planes)
    del planes[3:]
    clipped, black, unusable = np.zeros((3, *planes[0].shape), bool)
    over = {}
    for channel, plane in enumerate(planes):  # one at a time: photographs may be huge
        if bits:
            codes = picture.scaled(np.arange(2**bits, dtype=plane.dtype))
            table, first = (
                linearize(codes, transfer, channel),
                int((codes <= SATURATED[bits]).sum()),
            )
            over[CLIPPED_LAYER + "RGB"[channel]] = plane >= first
            clipped |= plane >= first
            planes[channel] = table[plane]
            black |= planes[channel] <= table[0]
        else:
            unusable |= ~(np.isfinite(plane) & (plane >= 0))
    invalid = int(unusable.sum())
    if bits and picture.header.color.matrix is not None:
        # Sums of saturated and other channels have no bound.
        planes = to_linear_srgb(planes, picture.header.color.matrix)
        whole = np.logical_and.reduce(list(over.values()))
        unusable |= clipped & ~whole
        over = {name: whole for name in over}
    for plane in planes:
        plane[unusable] = 0
    layers = {**dict(zip("RGB", planes, strict=True)), "bad": unusable}
    if clipped.any():
        layers |= over
    if mask is not None:
        layers["A"] = mask
        clipped &= mask
    del planes, over
    channels = _resample(layers, frame, scale)
    header = _mark_unusable(channels, saturation_radiance(transfer, bits) if bits else None)
    if bits:
        first_step, last_step = quantization_steps(transfer, bits)
        header |= {FIRST_STEP: first_step, LAST_STEP: last_step}
    # Half floats represent all 8-bit codes, unless a response curve puts some close together.
    half = bits == 8 and not isinstance(transfer, SampledCurve)
    write_exr(path, channels, header, half=half)
    return _describe(picture, frame, mask, clipped, black, invalid)


def _copy_jpeg(picture: ImageFile, frame: Frame, path: Path) -> ConvertedPhotograph:
    """Copy a JPEG to ``path`` with its own suffix, and write its mask."""
    codes, mask = picture.stored()[:3], None
    most = SATURATED[8] * 255
    clipped, black = (np.any([test(c) for c in codes], axis=0) for test in (
        lambda c: c > most, lambda c: c == 0))  # fmt: skip
    shutil.copyfile(frame.image, path.with_suffix(".jpg"))
    if frame.mask is not None:
        mask = read_mask(frame.mask, codes[0].shape)
        clipped &= mask
        beside = path.with_name(f"{masks_of(path.stem)[0]}.png")
        Image.fromarray(mask.astype(np.uint8) * 255).save(beside)
    return _describe(picture, frame, mask, clipped, black, 0)


def _describe(
    picture: ImageFile,
    frame: Frame,
    mask: np.ndarray | None,
    clipped: np.ndarray,
    black: np.ndarray,
    invalid: int,
) -> ConvertedPhotograph:
    """Return the properties; ``clipped`` and ``black`` (H, W) mark saturated and black pixels."""
    return ConvertedPhotograph(
        bits=picture.bits, decoded=str(picture.transfer(frame.transfer)),
        color=picture.header.color.name, remarks=tuple(picture.remarks()),
        saturated=int(clipped.sum()),
        crushed=0.0 if mask is None else float(black[mask].sum() / max(1, mask.sum())),
        invalid=invalid, masked=mask is not None, empty=mask is not None and not mask.any(),
        inverted=mask is not None and _is_inverted(mask),
    )  # fmt: skip


def _mark_unusable(channels: dict[str, np.ndarray], least: float | None) -> dict[str, float]:
    """Mark unusable pixels and saturated channels in place; return entries for the header."""
    touched = channels.pop("bad") > PART
    over = {name: channels.pop(CLIPPED_LAYER + name, None) for name in "RGB"}
    parts = {name: part for name, part in over.items() if part is not None}
    for part in parts.values():
        touched |= (part > PART) & (part < 1 - PART)
    for name in "RGB":
        if name in parts:
            channels[name][parts[name] >= 1 - PART] = CLIPPED
        channels[name][touched] = UNUSABLE
    return {SATURATION: least} if parts and least is not None else {}


def _is_inverted(mask: np.ndarray) -> bool:
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return bool(border.mean() > BORDER and not mask.all())


def _resample(
    layers: dict[str, np.ndarray], frame: Frame, scale: tuple[float, float]
) -> dict[str, np.ndarray]:
    """Undistort and shrink layers; remove them from the input, because they may be huge."""
    names = list(layers)
    straight = undistort_planes([np.asarray(layers.pop(name), np.float32) for name in names], frame)
    return {
        name: average_area(plane[..., None], scale)[..., 0]
        for name, plane in zip(names, straight, strict=True)
    }


def _read_mask(frame: Frame, picture: ImageFile, planes: Sequence[np.ndarray]) -> np.ndarray | None:
    """Return the mask (H, W) from the alpha channel, a file, or both; None without any."""
    opaque = None
    if len(planes) > 3:
        alpha = picture.scaled(planes[3]) if picture.bits else planes[3]
        opaque = alpha >= (IN_MASK if picture.bits else ON_OBJECT) if alpha.min() < 1 else None
    if frame.mask is None:
        return opaque
    inside = read_mask(frame.mask, planes[0].shape)
    return inside if opaque is None else inside & opaque


def photograph_notes(frames: Sequence[Frame], views: Sequence[ConvertedPhotograph]) -> list[str]:
    """Return sentences about the problems of V photographs."""
    count, low = len(views), {c.bits for c in views if c.bits}

    def note(chosen: Sequence[bool], words: str, least: float = 0) -> list[str]:
        names = [f.image.name for f, is_chosen in zip(frames, chosen, strict=True) if is_chosen]
        several = f"{len(names)} of {count} photographs, {names[0] if names else ''} first"
        found = len(names) > least
        return [f"{names[0] if len(names) == 1 else several}: {words}"] if found else []

    clipped, invalid = (sum(getattr(c, name) for c in views) for name in ("saturated", "invalid"))
    dark = [c.crushed for c in views if c.crushed > CRUSHED]
    kinds = " and ".join(map(str, sorted(low)))
    curves = " and ".join(sorted({c.decoded for c in views if c.bits}))
    colors = dict.fromkeys(c.color for c in views if c.color)
    remarks = dict.fromkeys(remark for c in views for remark in c.remarks)
    return [
        *note([c.bits > 0 for c in views],
              f"not HDR: of {kinds} bits, decoded as {curves}. {clipped} saturated pixels"
              f"{clipped_where(c.masked for c in views)}"),
        *note([c.crushed > CRUSHED for c in views],
              f"crushed blacks ({sum(dark) / max(1, len(dark)):.0%} of the object's pixels "
              "have a channel of 0): darker radiance is lost; expose longer or use HDR."),
        *note([f.lens is not None for f in frames],
              "undistorted; the focal length is kept, and empty borders are cropped."),
        *(line for name in colors for line in note([c.color == name for c in views],
              f"converted to linear sRGB from {name}; colours outside of sRGB are cut off.")),
        *(line for text in remarks for line in note([text in c.remarks for c in views], text)),
        *note([c.invalid > 0 for c in views],
              f"{counted(invalid, 'pixel')} {are(invalid)} NaN, infinite or negative; ignored."),
        *note([c.empty for c in views], "not used, because the mask is empty."),
        *note([c.inverted for c in views],
              "the mask includes the border; if the object is black in it, invert the "
              "masks: white is the object.", least=count / 2),
        *note([not c.masked for c in views],
              "no mask: anything in front of the object is treated as its surface."),
    ]  # fmt: skip

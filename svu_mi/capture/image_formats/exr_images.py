"""EXR images: header, chromaticities, and the channels that are red, green, blue and alpha."""

from pathlib import Path

import numpy as np

from svu_mi.capture.image_formats.color_space import ColorSpace, from_chromaticities
from svu_mi.capture.image_formats.image_header import ImageHeader
from svu_mi.core.io.exr import read_header, read_pixels
from svu_mi.errors import CaptureError, excerpt

OTHER_COLORS = {("X", "Y", "Z"): "CIE XYZ", ("Y", "RY", "BY"): "luminance and chroma"}
# Attributes that change the meaning of values, with the number that does not.
IGNORED = {"whiteLuminance": 1.0, "exposure": 0.0, "pixelAspectRatio": 1.0}


def open_exr(path: Path) -> ImageHeader:
    """Read the header of an EXR."""
    header = read_header(path)
    try:
        color = from_chromaticities(header.chromaticities)
    except ValueError:
        color = ColorSpace()
        remarks = ["chromaticities in the header are invalid; taken as Rec. 709."]
    else:
        remarks = []
    if header.parts > 1:
        remarks.append(f"several parts; the first ({header.attributes.get('name')}) is used.")
    for name, neutral in IGNORED.items():
        value = header.attributes.get(name, neutral)
        if value != neutral:
            remarks.append(
                f"{name} = {excerpt(value, 20)} in the header is ignored; apply it to the values "
                "if it differs between photographs."
            )
    return ImageHeader(
        size=header.size, color=color, cropped=header.cropped, attributes=header.attributes,
        remarks=tuple(remarks),
    )  # fmt: skip


def read_exr_image(path: Path, header: ImageHeader) -> list[np.ndarray]:
    """Return R, G, B, and alpha if present."""
    channels = _layer_channels(read_pixels(path, header.attributes))
    for names, space in OTHER_COLORS.items():
        if channels.keys() >= set(names) and not channels.keys() >= set("RGB"):
            raise CaptureError(
                f"{path}: contains {space} ({', '.join(names)}) instead of RGB; export it as "
                "plain RGB."
            )
    grey = channels.get("Y")
    colors = [channels.get(name, grey) for name in "RGB"]
    planes = [plane for plane in colors if plane is not None]
    if len(planes) < 3:
        raise CaptureError(
            f"{path}: expected the channels R, G, B (or Y) in its first part, found "
            f"{excerpt(', '.join(channels))}; export it as plain RGB or RGBA."
        )
    return planes + ([channels["A"]] if "A" in channels else [])


def _layer_channels(channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the channels without a layer, else those of the only or the "Combined" layer."""
    if "R" in channels or "Y" in channels:
        return channels
    layers = [name.removesuffix("R") for name in channels if name.endswith(".R")]
    whole = [layer for layer in layers if layer.endswith("Combined.")]  # Blender's final image
    for prefixes in (layers, whole):
        if len(prefixes) == 1:
            return {
                name.removeprefix(prefixes[0]): plane
                for name, plane in channels.items() if name.startswith(prefixes[0])
            }  # fmt: skip
    return channels

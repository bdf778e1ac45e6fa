"""ICC profiles with a matrix and tone curves (ICC.1:2022, https://www.color.org/icc_specs2.xalter).

Colour values of other profiles (tables) are not converted.
"""

import struct
from functools import lru_cache

import numpy as np

from svu_mi.capture.image_formats.color_space import (
    ColorSpace,
    from_colorants,
    gamma_curve,
    sampled_curve,
)
from svu_mi.capture.tone_curve import SampledCurve, Transfer, linearize
from svu_mi.errors import excerpt

HEAD, ENTRY = 128, 12  # bytes of the header, and of an entry of the table of tags
MAX_TAGS = 200
LARGEST = 2**24  # bytes; profiles with large tables have some MB
COUNTS = (1, 3, 4, 5, 7)  # parameters of parametric curves of type 0 to 4
XYZ_TAGS, CURVE_TAGS = (b"rXYZ", b"gXYZ", b"bXYZ"), (b"rTRC", b"gTRC", b"bTRC")


@lru_cache(maxsize=4)  # photographs of a capture share their profile
def read_profile(data: bytes) -> ColorSpace:
    """Return the colour space of an ICC profile.

    Raises:
        ValueError: with a clause as reason; the profile is damaged or has no matrix.
    """
    try:
        tags, space = _tags(data), data[16:20]
        if space == b"GRAY":
            return ColorSpace(transfer=_curve(tags[b"kTRC"], "its ICC profile"))
        if space != b"RGB ":
            raise ValueError("it is not for RGB")
        name = _profile_name(data)
        if not tags.keys() >= {*XYZ_TAGS, *CURVE_TAGS}:
            raise ValueError("it has tables instead of a matrix")
        colorants = np.array([struct.unpack_from(">3i", tags[tag], 8) for tag in XYZ_TAGS]).T
        if len({tags[tag] for tag in CURVE_TAGS}) == 1:
            curve = _curve(tags[b"rTRC"], name)
        else:
            curves = [_curve(tags[tag], name) for tag in CURVE_TAGS]
            curve = sampled_curve(lambda x: np.stack(
                [linearize(x, one, k) for k, one in enumerate(curves)], axis=1), name)  # fmt: skip
        return from_colorants(colorants / 2**16, name, curve)
    except (KeyError, IndexError, struct.error, OverflowError) as error:
        raise ValueError("it is damaged") from error


def _profile_name(data: bytes) -> str:
    """Return the description of a profile, such as Display P3."""
    try:
        tag = _tags(data)[b"desc"]
        if tag[:4] == b"mluc":
            length, offset = struct.unpack_from(">II", tag, 20)
            text = tag[offset : offset + length].decode("utf-16-be", "replace")
        else:
            (length,) = struct.unpack_from(">I", tag, 8)
            text = tag[12 : 12 + length].decode("latin-1")
        return excerpt(text.rstrip("\0"), 60) or "an ICC profile"
    except (KeyError, ValueError, struct.error):
        return "an ICC profile"


def not_followed(reason: object, profile: bytes | None = None) -> str:
    """Return the clause about a colour space that cannot be converted."""
    label = "the colour space in the header" if profile is None else _profile_name(bytes(profile))
    return f"{label} is not followed, because {reason}; taken as sRGB."


def _tags(data: bytes) -> dict[bytes, bytes]:
    """Return the contents of all tags by signature."""
    (count,) = struct.unpack_from(">I", data, HEAD)
    if data[36:40] != b"acsp" or count > MAX_TAGS or len(data) > LARGEST:
        raise ValueError("it is damaged")
    tags = {}
    for index in range(count):
        name, start, length = struct.unpack_from(">4sII", data, HEAD + 4 + ENTRY * index)
        tags[name] = data[start : start + length]
    return tags


def _curve(tag: bytes, name: str) -> Transfer | SampledCurve:
    """Return the tone curve of a tag of type ``curv`` or ``para``."""
    if tag[:4] == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        if 2 + count > len(tag):
            raise ValueError("it is damaged")
        numbers = np.array(struct.unpack_from(f">{count}H", tag, 12))
        if count < 2:
            return gamma_curve(numbers[0] / 2**8) if count else "linear"
        places = np.linspace(0, 1, count)
        return sampled_curve(lambda x: np.interp(x, places, numbers / 65535), name)
    if tag[:4] != b"para":
        raise ValueError("its tone curve has an unknown type")
    (kind,) = struct.unpack_from(">H", tag, 8)
    given = np.array(struct.unpack_from(f">{COUNTS[kind]}i", tag, 12)) / 2**16
    g, a, b, c, d, e, f = map(float, np.pad(given, (0, 7 - len(given))))
    if kind == 0:
        return gamma_curve(g)
    if kind in (1, 2):  # d and e follow from a, b and c
        d, e, c, f = -b / a if a else 0.0, c, 0.0, c
    return sampled_curve(
        lambda x: np.where(x >= d, np.maximum(a * x + b, 0) ** g + e, c * x + f), name
    )

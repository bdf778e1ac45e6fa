"""Colour spaces of images and their conversion to linear sRGB.

Primaries: ITU-T H.273 (CICP), Adobe RGB (1998), and S-2014-004 (ACEScg). White points are adapted
with the Bradford transform (ICC.1:2022, annex E).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from svu_mi.capture.tone_curve import SampledCurve, Transfer, decoded
from svu_mi.errors import CaptureError

# x, y of red, green, blue and white.
D65 = (0.3127, 0.3290)
REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *D65)
PRIMARIES = {
    "Display P3": (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, *D65),
    "Rec. 2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *D65),
    "Adobe RGB": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *D65),
    "ACEScg": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
    "ACES2065-1": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767),
    "DCI-P3": (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.314, 0.351),
    "Rec. 601": (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *D65),
    "PAL": (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, *D65),
}
CICP_PRIMARIES = {
    1: "", 2: "", 5: "PAL", 6: "Rec. 601", 7: "Rec. 601", 9: "Rec. 2020", 11: "DCI-P3",
    12: "Display P3",
}  # fmt: skip
CICP_GAMMA = {4: 2.2, 5: 2.8, 8: 1.0}
CICP_VIDEO = (1, 6, 14, 15)  # transfer function of Rec. 709
CICP_SCREEN = {16: "PQ", 18: "HLG"}
BRADFORD = np.array([
    [0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]
])  # fmt: skip
PCS_WHITE = np.array([0.9642, 1.0, 0.8249])  # D50 of ICC profiles
SAME = 5e-3  # tolerance of matrices and chromaticities, for rounding
CODES = 2**16  # samples of a curve, so that codes of 8 and 16 bits are exact


@dataclass(frozen=True, eq=False)
class ColorSpace:
    """Conversion of the values of an image to linear sRGB.

    Attributes:
        name: source of the matrix, for messages; empty for sRGB.
        transfer: decoding of the values of integer images.
        matrix: (3, 3), from linear values of the file to linear sRGB; None for sRGB.
    """

    name: str = ""
    transfer: Transfer | SampledCurve = "srgb"
    matrix: np.ndarray | None = None


def to_linear_srgb(planes: Sequence[np.ndarray], matrix: np.ndarray | None) -> list[np.ndarray]:
    """Convert linear planes R, G, B; colours outside of sRGB get 0 in a channel.

    Pixels that are negative in the file remain negative.
    """
    if matrix is None:
        return list(planes)
    rows = matrix.astype(np.float32)
    inside = np.minimum(np.minimum(*planes[:2]), planes[2]) >= 0
    converted = []
    for row in rows:
        plane = row[0] * planes[0]
        for factor, other in zip(row[1:], planes[1:], strict=True):
            plane += factor * other
        plane[inside & (plane < 0)] = 0
        converted.append(plane)
    return converted


def from_primaries(
    primaries: Sequence[float], name: str, transfer: Transfer | SampledCurve = "linear"
) -> ColorSpace:
    """Return the colour space of x, y of red, green, blue and white; ValueError if invalid."""
    matrix = np.linalg.inv(rgb_to_xyz(REC_709)) @ _adaptation(
        _white(primaries), _white(REC_709)
    ) @ rgb_to_xyz(primaries)  # fmt: skip
    return _color_space(name, transfer, matrix)


def from_chromaticities(
    given: Sequence[float], transfer: Transfer | SampledCurve = "linear"
) -> ColorSpace:
    """Return the colour space of chromaticities in a header."""
    if np.allclose(given, REC_709, atol=SAME):
        return ColorSpace(transfer=transfer)
    names = [name for name, xy in PRIMARIES.items() if np.allclose(given, xy, atol=SAME)]
    return from_primaries(given, (names or ["primaries in the header"])[0], transfer)


def from_colorants(
    colorants: np.ndarray, name: str, transfer: Transfer | SampledCurve
) -> ColorSpace:
    """Return the colour space of an ICC profile: columns XYZ (D50) of red, green, blue."""
    if not np.allclose(colorants.sum(axis=1), PCS_WHITE, atol=0.03):
        raise ValueError("its primaries do not add to white")
    to_pcs = _adaptation(_white(REC_709), PCS_WHITE) @ rgb_to_xyz(REC_709)
    return _color_space(name, transfer, np.linalg.inv(to_pcs) @ colorants)


def from_cicp(primaries: int, transfer: int, matrix: int = 0, whole: int = 1) -> ColorSpace:
    """Return the colour space of code points (H.273); ValueError if they are not supported.

    Raises:
        CaptureError: values for HDR screens, which are not proportional to radiance.
    """
    if transfer in CICP_SCREEN:
        raise CaptureError(
            f"is encoded for HDR screens ({CICP_SCREEN[transfer]}); export it as EXR, or for sRGB."
        )
    if primaries not in CICP_PRIMARIES or matrix != 0 or whole != 1:
        raise ValueError("its primaries, matrix or range are not supported")
    curve: Transfer | SampledCurve = "srgb"
    if transfer in CICP_VIDEO:
        curve = sampled_curve(lambda x: np.where(
            x < 0.081, x / 4.5, ((x + 0.099) / 1.099) ** (1 / 0.45)), "Rec. 709")  # fmt: skip
    elif transfer in CICP_GAMMA:
        curve = gamma_curve(CICP_GAMMA[transfer])
    elif transfer not in (2, 13):  # unspecified, sRGB
        raise ValueError("its transfer function is not supported")
    name = CICP_PRIMARIES[primaries]
    return from_primaries(PRIMARIES.get(name, REC_709), name, curve)


def gamma_curve(power: float) -> Transfer | SampledCurve:
    """Return the curve encoded ** power."""
    if not 0.1 < power < 10:  # NaN fails, too
        raise ValueError("its gamma is out of range")
    return sampled_curve(lambda x: x**power, f"gamma {power:.3g}")


def sampled_curve(curve: Callable[[np.ndarray], np.ndarray], name: str) -> Transfer | SampledCurve:
    """Sample a curve, (N,) to (N,) or (N, 3); return the name of an equal standard one.

    ValueError if it decreases or is black.
    """
    codes = np.arange(CODES) / (CODES - 1)
    with np.errstate(all="ignore"):  # results that are not finite are refused
        values = np.asarray(curve(codes), np.float64)
    values = np.broadcast_to(values.reshape(CODES, -1), (CODES, 3))
    if not (np.isfinite(values).all() and (np.diff(values, axis=0) >= 0).all()):
        raise ValueError("its tone curve is not ascending")
    if not (values[0] >= 0).all() or not (values[-CODES // 50] > 0).all():
        raise ValueError("its tone curve is black or negative")
    values = values / values[-1]
    standard: tuple[Transfer, ...] = ("srgb", "linear")
    for transfer in standard:
        same = decoded(codes[:, None], transfer)
        if np.allclose(values, same, rtol=1e-3, atol=1e-4 if transfer == "srgb" else 1e-5):
            return transfer
    return SampledCurve(name=name, codes=codes.astype(np.float32), values=values)


def rgb_to_xyz(primaries: Sequence[float]) -> np.ndarray:
    """Return the matrix from linear RGB to XYZ, with Y = 1 for white; ValueError if invalid."""
    xy = np.array(primaries[:6], np.float64).reshape(3, 2)
    columns = np.column_stack([xy, 1 - xy.sum(axis=1)]).T
    if not abs(np.linalg.det(columns)) > 1e-4:  # NaN fails, too
        raise ValueError("its primaries are damaged")
    return columns * np.linalg.solve(columns, _white(primaries))


def _color_space(name: str, transfer: Transfer | SampledCurve, matrix: np.ndarray) -> ColorSpace:
    if not np.isfinite(matrix).all():
        raise ValueError("its primaries are damaged")
    if np.allclose(matrix, np.eye(3), atol=SAME):
        return ColorSpace(transfer=transfer)
    return ColorSpace(name, transfer, matrix)


def _white(primaries: Sequence[float]) -> np.ndarray:
    x, y = primaries[6:]
    if not (0 < x < 1 and 0 < y < 1):
        raise ValueError("its white point is invalid")
    return np.array([x / y, 1, (1 - x - y) / y])


def _adaptation(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the Bradford transform (3, 3) between two white points."""
    gain = (BRADFORD @ target) / (BRADFORD @ source)
    return np.linalg.inv(BRADFORD) @ (gain[:, None] * BRADFORD)

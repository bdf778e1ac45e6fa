"""Per-texel results as EXR maps."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import svu_mi
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.errors import CaptureError, excerpt
from svu_mi.geometry.dilate import dilate
from svu_mi.parameters import CHANNELS
from svu_mi.posterior.estimate import Estimate
from svu_mi.recovery.uncertainty.texture_field import INTERVAL_MASS, TextureField

ENTROPY, COVERAGE, UNCERTAINTY = "entropy.exr", "coverage.exr", "uncertainty.exr"
GUTTER = 4  # texels; sufficient for bilinear lookups down to a quarter of the resolution


def write_maps(estimate: Estimate, folder: str | Path, *, gutter: int = GUTTER) -> None:
    """Write ``entropy.exr`` and ``coverage.exr``, each with the float32 channel Y.

    Entropy is in [0, 1]; coverage is the number of views that see a texel. Unseen texels have the
    prior's entropy (1 unless ``prior`` is given) and coverage 0. Outside the charts entropy is 1
    and coverage 0, except in a gutter of ``gutter`` texels with the nearest values.

    Raises:
        OutputError: a file cannot be written, or a value is NaN.
    """
    attributes = exr_attributes(estimate, preset=estimate.preset.name, gutter=gutter)
    for file, values, fill in ((ENTROPY, estimate.entropy, 1), (COVERAGE, estimate.coverage, 0)):
        image = padded_image(estimate, np.asarray(values).astype(np.float32), gutter, fill)
        write_exr(Path(folder) / file, {"Y": image}, attributes)


def write_uncertainty(estimate: Estimate, folder: Path) -> None:
    """Write ``uncertainty.exr``: standard deviations of all parameters, float32.

    Channels are ``roughness.sd``, ``metallic.sd`` and ``base_color.sd.R`` (.G, .B; no letter if
    R, G and B share one). Unseen texels have the prior's values. Texels outside the charts have 0,
    except in a gutter.
    """
    channels: dict[str, np.ndarray] = {}
    for name in estimate.posterior.axes:
        channels |= _channels(estimate, f"{name}.sd", estimate.posterior.sd(name))
    attributes = exr_attributes(estimate, preset=estimate.preset.name, gutter=GUTTER)
    write_exr(folder / UNCERTAINTY, channels, attributes)


def write_field(field: TextureField, folder: Path, attributes: Mapping[str, Any]) -> None:
    """Write ``uncertainty.exr`` of recovered textures: standard deviations and 90 % intervals.

    Adds ``roughness.low``, ``roughness.high`` and so on to the channels of ``write_uncertainty``.
    """
    channels: dict[str, np.ndarray] = {}
    for name in field.names:
        low, high = field.interval(name, INTERVAL_MASS)
        for kind, values in (("sd", field.sd(name)), ("low", low), ("high", high)):
            channels |= _channels(field, f"{name}.{kind}", values)
    about = {**attributes, "svu:level": INTERVAL_MASS, "svu:gutter": GUTTER}
    write_exr(folder / UNCERTAINTY, channels, about)


def _channels(result: Any, name: str, values: Any) -> dict[str, np.ndarray]:
    """Return values (T,) or (T, C) as named channels (H, W)."""
    table = np.asarray(values, np.float32)
    columns = table.reshape(len(table), -1).T
    letters = [""] if len(columns) == 1 else [".R", ".G", ".B"]
    return {
        f"{name}{letter}": padded_image(result, column, fill=0)
        for letter, column in zip(letters, columns, strict=True)
    }


def exr_attributes(result: Any, **more: Any) -> dict[str, Any]:
    """Return header entries for a file of an ``Estimate``, ``Guidance`` or ``Recovery``."""
    entries = {"version": svu_mi.__version__, "method": result.method, **more}
    return {f"svu:{name}": value for name, value in entries.items()}


def padded_image(
    result: Any, values: np.ndarray, gutter: int = GUTTER, fill: float = 1
) -> np.ndarray:
    """Lay values (T,) out as an (H, W) texture with a gutter around the charts.

    ``fill`` is the value beyond the gutter. Unseen texels keep their value.
    """
    return dilate(result.texels.to_image(values, fill), result.texels.inside(), gutter)


def read_map(path: Path) -> np.ndarray | None:
    """Return the channel Y (H, W) of an EXR file; None if the file is missing."""
    if not path.is_file():
        return None
    channels = read_exr(path)
    if "Y" not in channels:
        raise CaptureError(f"{path}: expected the channel Y, found {excerpt(', '.join(channels))}.")
    return channels["Y"]


def read_deviations(folder: Path) -> dict[str, np.ndarray]:
    """Return standard deviations (H, W, C) by parameter; empty without ``uncertainty.exr``."""
    path = folder / UNCERTAINTY
    channels = read_exr(path) if path.is_file() else {}
    planes = {name: [channels[f"{name}.sd{letter}"] for letter in ("", ".R", ".G", ".B")
                     if f"{name}.sd{letter}" in channels] for name in CHANNELS}  # fmt: skip
    return {name: np.stack(channels, axis=-1) for name, channels in planes.items() if channels}

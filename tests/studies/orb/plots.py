"""Photographs beside pictures of the recovered object."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from studies.orb.metrics import channel_scale
from studies.orb.targets import Target
from svu_mi.bench.plots import FAINT, INK, page
from svu_mi.capture.picture import srgb
from svu_mi.output.style import save_figure

Shown = tuple[str, Target, np.ndarray, dict[str, Any], bool]
WHITE = 0.98  # part of the object's pixels that are not clipped
LARGEST = 0.25  # difference of sRGB values that is shown as white


def draw_pictures(path: Path, label: str, shown: Sequence[Shown]) -> None:
    """Draw a row per test: photograph, picture, and their difference.

    Args:
        path: the PNG file.
        label: of the way of recovery.
        shown: title, target, picture (H, W, 3), the figures of its task, and whether those are
            of a picture with a scale per channel; one per row.

    Raises:
        OutputError: the file cannot be written.
    """
    figure = page(7.2, 2.6 * len(shown))
    for axes, (title, target, picture, found, scaled) in zip(
        figure.subplots(len(shown), 3, squeeze=False), shown, strict=True
    ):
        photograph, made = _comparable(target, picture, scaled=scaled)
        difference = np.abs(photograph - made).max(axis=-1)
        axes[0].imshow(photograph)
        axes[1].imshow(made)
        axes[2].imshow(difference, cmap="magma", vmin=0, vmax=LARGEST)
        first = found["single"][0]
        axes[0].set_title(f"{first['capture']}, {first['photograph']}", fontsize=9, color=INK)
        axes[1].set_title(f"{label}, {title}", fontsize=9, color=INK)
        axes[2].set_title(f"difference; PSNR-L {first['psnr_ldr']:.1f} dB", fontsize=9, color=FAINT)
        for one in axes:
            one.set_axis_off()
    save_figure(figure, path)


def _comparable(
    target: Target, picture: np.ndarray, *, scaled: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Tone-map photograph and picture alike, black outside the object."""
    if scaled:
        picture = picture * channel_scale(picture[target.mask], target.photograph[target.mask])
    mask = target.mask[..., None]
    bright = target.photograph[target.mask].max(axis=-1)
    white = max(float(np.quantile(bright, WHITE)), 1e-6)
    first, second = (
        srgb(np.where(mask, np.clip(x / white, 0, 1), 0)) for x in (target.photograph, picture)
    )
    return first, second

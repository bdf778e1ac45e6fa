"""What photographs show beyond the object: direct looks at the light, where that is far away."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.poses import film_size
from svu_mi.capture.rays import evenly, pixel_rays, table_of
from svu_mi.capture.scene import to_world
from svu_mi.errors import CaptureError
from svu_mi.interop import owned
from svu_mi.light.cells import nearest_cells

PIXELS = 4000  # that are looked at in each photograph, about
SD = 0.1  # of the logarithm of a cell's mean: parallax, and what a photograph does not show of it
DARK = 1e-4  # part of the mean radiance that counts as black


class CellLooks(NamedTuple):
    """The logarithm of the mean radiance (N, 3) that is seen of N cells, and its precision (N,);
    0 both where nobody looks."""

    precision: np.ndarray
    logarithm: np.ndarray


@dataclass(frozen=True)
class Looks:
    """Pixels that show the light itself.

    Attributes:
        direction: (P, 3) float64, unit, in the frame that the light stands still in.
        radiance: (P, 3) float64.
    """

    direction: np.ndarray
    radiance: np.ndarray

    def at(self, number: int) -> CellLooks:
        """Return what they say of N even cells."""
        cells = nearest_cells(self.direction, number)
        count = np.bincount(cells, minlength=number)
        sums = [np.bincount(cells, channel, number) for channel in self.radiance.T]
        mean = np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]
        logarithm = np.log(np.maximum(mean, DARK * self.radiance.mean()))
        return CellLooks((count > 0) / SD**2, np.where(count[:, None] > 0, logarithm, 0))

    @staticmethod
    def of(capture: Capture, *, moves: bool = False) -> Looks:
        """Look at the pixels of all photographs that show no shape of the scene.

        Args:
            capture: photographs of surroundings that are far away.
            moves: whether the light turns with the cameras.

        Raises:
            CaptureError: no pixel shows any background, or all of it is black.
        """
        used = [k for k in range(capture.count) if capture.used[k]]
        pixels = [_grid(capture, k) for k in used]
        view = np.repeat(np.arange(len(used)), [len(rows) for rows, _ in pixels])
        rows, columns = (np.concatenate(part) for part in zip(*pixels, strict=True))
        numbers = (owned(mi.UInt32, part) for part in (view, rows, columns))
        rays = pixel_rays(
            table_of([capture.sensors[k] for k in used]), tuple(numbers), 1, evenly(1)
        )
        hit, towards = capture.scene.ray_test(rays), mi.Vector3f(rays.d)
        dr.eval(hit, towards)
        colors = np.concatenate([
            np.where(_beyond(capture, k)[..., None], capture.images[k], np.nan)[at]
            for k, at in zip(used, pixels, strict=True)
        ]).astype(np.float64)  # fmt: skip
        kept = ~hit.numpy() & np.isfinite(colors).all(axis=1)
        if not kept.any():
            raise CaptureError(
                "No photograph shows anything beyond the object, so there is no background to take "
                "light from; leave --background out."
            )
        if not colors[kept].mean() > 0:
            raise CaptureError(
                "All that the photographs show beyond the object is black: it was cut out, and is "
                "no light; leave --background out."
            )
        direction = towards.numpy().T.astype(np.float64)
        if moves:
            turned = np.stack([to_world(capture.sensors[k])[:3, :3] for k in used])
            direction = np.einsum("pi,pij->pj", direction, turned[view])
        return Looks(direction[kept], colors[kept])


def _grid(capture: Capture, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of pixels that are evenly spread over a photograph."""
    width, height = film_size(capture.sensors[view])
    step = max(int(np.sqrt(width * height / PIXELS)), 1)
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    return rows.ravel(), columns.ravel()


def _beyond(capture: Capture, view: int) -> np.ndarray:
    mask = capture.masks[view]
    return np.ones(capture.images[view].shape[:2], bool) if mask is None else ~mask

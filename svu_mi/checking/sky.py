"""The given light: irradiance and highlights for any orientation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np
import scipy

from svu_mi.capture import Capture
from svu_mi.capture.scene import find_environment
from svu_mi.interop import fibonacci, owned
from svu_mi.light.cells import Cells, light_cells
from svu_mi.light.environment import read_environment
from svu_mi.light.levels import Levels, filter_light
from svu_mi.light.lighting import band_limit, look_up
from svu_mi.reflection.lobes import zonal_profile

DIRECTIONS = fibonacci(256)  # for visibility
CELLS, COARSE = 2048, 64  # of the light, that irradiance is summed from, and that they split
SAME = 1e-3  # of a map's radiance, that it may vary by and still be even
WIDTHS = (0.06, 0.18, 0.4)  # alpha of the lobes that highlights are compared with


@dataclass(frozen=True)
class Sky:
    """Distant light: flux (M, 3) of cells, radiance times solid angle, from unit directions (M, 3)
    in the frame of the map, the light under a lobe of each of ``WIDTHS``, and the rotation (3, 3)
    from the mesh to the map."""

    flux: np.ndarray
    toward: np.ndarray
    lobes: Levels
    to_local: np.ndarray

    @staticmethod
    def of(emitter: Any, mesh_turn: np.ndarray) -> Sky:
        """Filter an emitter; corrections turn the mesh by ``mesh_turn`` (3, 3) before it is lit."""
        environment = read_environment(emitter)
        flux, toward = read_cells(light_cells(environment, COARSE, CELLS).fine)
        return Sky(
            flux=flux,
            toward=toward @ environment.to_local.T,
            lobes=filter_light(band_limit(environment, 1), WIDTHS, partial(zonal_profile, "ggx")),
            to_local=environment.to_local @ mesh_turn,
        )

    def arriving(self, matrix: np.ndarray) -> np.ndarray:
        """Return the flux (K, 3) around ``DIRECTIONS`` of a map turned by ``matrix`` (3, 3)."""
        cell = scipy.spatial.cKDTree(self._local(DIRECTIONS, matrix)).query(self.toward)[1]
        count = len(DIRECTIONS)
        return np.stack([np.bincount(cell, self.flux[:, c], count) for c in range(3)], axis=-1)

    def reflected(self, directions: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """Return the light (L, S, 3) under lobes around directions (S, 3) of the mesh's frame."""
        local = owned(mi.Vector3f, self._local(directions, matrix).T)
        found = [look_up(texture, local) for texture in self.lobes.textures]
        return np.array([[channel.numpy() for channel in one] for one in found]).swapaxes(1, 2)

    def _local(self, directions: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        return directions @ (matrix.T @ self.to_local).T


def read_cells(cells: Cells) -> tuple[np.ndarray, np.ndarray]:
    """Return the flux (M, 3) and the direction (M, 3), in world space, of M cells of the light."""
    flux, toward = (a.numpy().reshape(-1, 4)[:, :3] for a in (cells.flux, cells.toward))
    return flux, toward


def emitter_of(capture: Capture) -> Any:
    """Return the environment emitter of a capture; None if it was loaded without one."""
    if not capture.scene.emitters():
        return None
    return find_environment(capture.scene, str(capture.source or "scene"))


def is_even(emitter: Any) -> bool:
    """Whether the light is the same from everywhere: constant, or a map of one colour."""
    if emitter.class_name() != "EnvironmentMapEmitter":
        return bool(emitter.class_name() == "ConstantBackgroundEmitter")
    pixels = np.array(mi.traverse(emitter)["data"])
    return bool((np.ptp(pixels, axis=(0, 1)) <= SAME * pixels.max(axis=(0, 1))).all())

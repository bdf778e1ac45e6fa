"""Refinement of shading normals: a smooth field of tilts, by Gauss-Newton steps.

Tilts are interpolated between control points on the surface. Their prior is a normal distribution,
whose width is estimated with the tilts (EM algorithm): normals stay where the photographs show no
error.
"""

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
import scipy

from svu_mi.calibration.normals import tilt_equations as eq
from svu_mi.capture.capture import Capture
from svu_mi.capture.mesh import arrays, make_mesh
from svu_mi.capture.replace_material import with_normals
from svu_mi.core.arrays import evenly_spaced
from svu_mi.core.progress import Progress
from svu_mi.geometry.mapped_normals import tangent_frame
from svu_mi.geometry.texels import Texels, filled_image, texels
from svu_mi.pipeline import estimate

SIDES = 48, 48, 48, 96  # texels per side, of each Gauss-Newton step
CONTROLS, NEAR = 150, 8  # control points, and those between which a tilt is interpolated
OPPOSITE = 0.06  # distance that is added for perpendicular normals, relative to the extent
WIDEST = np.radians(3.0)  # first standard deviation of tilts at control points
MISSED = 0.45  # sd of tilts that materials absorb, relative to the width of tilts (calibrated)
ROWS = 2**14  # of the field that become dense at a time
STEPS = 20  # EM steps of each Gauss-Newton step


@dataclass(frozen=True)
class RefinedNormals:
    """Normals that were tilted so that the model agrees with the photographs.

    Attributes:
        capture: the capture whose object has the normal map.
        normals: (H, W, 3) float32 in [0, 1], as for Mitsuba's ``normalmap``.
        sd: (H, W) float32, standard deviation of the tilt [degrees].
    """

    capture: Capture
    normals: np.ndarray
    sd: np.ndarray


def refine_normals(
    capture: Capture, size: tuple[int, int], progress: Progress
) -> RefinedNormals | None:
    """Tilt shading normals smoothly so that the model agrees with the photographs.

    Return None if R^2 of held-out photographs decreases; a line of ``progress`` reports it. Neither
    errors that vary within about a tenth of the object nor errors of rough surfaces are found.
    Visibility and curvature stay. ``size`` (W, H) is the size of the normal map.
    """
    centers, tilts, covariance, width = _fitted(capture, progress)
    fine = texels(capture.mesh, size)
    field = _field(fine, centers)
    bare = texels(make_mesh(capture.shape.id(), arrays(capture.mesh)), size)
    found = mi.Vector3f(_tilted(fine, field, tilts).normal)
    local = tangent_frame(bare.normal, bare.sides[0]).to_local(found)
    image = filled_image(fine, (eq.vectors(local) + 1) / 2).astype(np.float32)
    made = with_normals(capture, image)
    with progress.stage("Predicting held-out photographs"):
        results = [estimate(one, texels(one.mesh, SIDES[-1])).prediction for one in (capture, made)]
        before, after = (np.nan if one is None else one.r2 for one in results)
    angle = np.degrees(np.sqrt(2 * np.square(field @ tilts).mean()))
    verb = "kept" if after < before else "tilted"
    progress.say(
        f"Normals were {verb}: a tilt of {angle:.2g} degrees (rms) predicts held-out photographs "
        f"with R^2 {after:.3f} instead of {before:.3f}."
    )
    if verb == "kept":
        return None
    root = np.linalg.cholesky(covariance)
    parts = (field[first : first + ROWS] @ root for first in range(0, field.shape[0], ROWS))
    squares = np.concatenate([np.square(part).sum(axis=1) for part in parts])
    variance = squares.reshape(2, -1).sum(axis=0)
    sd = filled_image(fine, np.degrees(np.sqrt(variance + (MISSED * width) ** 2))[:, None])[..., 0]
    return RefinedNormals(made, image, sd.astype(np.float32))


def _fitted(capture: Capture, progress: Progress) -> tuple[Any, ...]:
    """Return K centers (K, 6), tilts there (3 K,), their covariance, and their prior's width."""
    grid = texels(capture.mesh, SIDES[-1])
    centers = _places(grid)[evenly_spaced(grid.count, CONTROLS)]
    tilts, width = np.zeros(3 * len(centers)), WIDEST
    with progress.stage("Refining normals", len(SIDES)) as stage:
        for number, side in enumerate(SIDES):
            grid = texels(capture.mesh, side)
            field = _field(grid, centers)
            known = estimate(capture, _tilted(grid, field, tilts), preset=eq.SWITCHES)
            equations = eq.tilt_equations(known, grid)
            tilts, covariance, width = _step(equations, field, tilts, width)
            stage.update(number + 1, len(SIDES))
    return centers, tilts, covariance, width


def _places(grid: Texels) -> np.ndarray:
    """Return positions and scaled normals (T, 6): opposite sides are far from each other."""
    return np.hstack([eq.vectors(grid.position), OPPOSITE * grid.extent * eq.vectors(grid.normal)])


def _field(grid: Texels, centers: np.ndarray) -> Any:
    """Return two coordinates of texels' tilts by vectors at K centers, sparse (2 T, 3 K)."""
    count = min(NEAR, len(centers) - 1)
    distance, near = scipy.spatial.cKDTree(centers).query(_places(grid), count + 1)
    weight = (1 - (distance[:, :-1] / np.maximum(distance[:, -1:], 1e-30)) ** 2) ** 2 + 1e-6
    weight /= weight.sum(axis=1, keepdims=True)
    parts = weight.ravel(), near[:, :-1].ravel(), np.arange(grid.count + 1) * count
    weights = scipy.sparse.csr_array(parts, (grid.count, len(centers)))
    axes = np.concatenate(eq.tangents(grid)).T
    both = scipy.sparse.vstack([weights, weights])
    return scipy.sparse.hstack([both * x[:, None] for x in axes], format="csr")


def _tilted(grid: Texels, field: Any, tilts: np.ndarray) -> Texels:
    """Return texels with normals that are tilted by vectors at the centers (3 K,)."""
    return eq.tilted(grid, np.sum((field @ tilts).reshape(2, -1, 1) * eq.tangents(grid), axis=0))


def _step(
    equations: tuple[np.ndarray, ...], field: Any, tilts: np.ndarray, width: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return tilts at centers (3 K,), their covariance, and the width of their prior."""
    A, b = equations
    blocks = [[scipy.sparse.diags_array(x) for x in row] for row in np.moveaxis(A, 0, 2)]
    matrix = (field.T @ scipy.sparse.block_array(blocks) @ field).toarray()
    right = field.T @ b.T.ravel() + matrix @ tilts
    for _ in range(STEPS):
        covariance = np.linalg.inv(matrix + np.eye(len(tilts)) / width**2)
        tilts = covariance @ right
        width = np.sqrt((tilts**2 + np.diag(covariance)).mean())
    return tilts, covariance, width

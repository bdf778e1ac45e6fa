"""Scale and place of the mesh: other units, and the similarity that fits the masks."""

from dataclasses import replace
from itertools import compress
from typing import Any, NamedTuple

import numpy as np

from svu_mi.calibration.checks.axis_hypotheses import with_changed_mesh
from svu_mi.calibration.checks.thumbnails import Thumbnails, silhouettes
from svu_mi.capture.capture import Capture
from svu_mi.capture.mesh_scale import FACTORS
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import changed_sensor, focal_length, principal_point

CLIP = np.array([1e-2, 1e2])  # clip planes, relative to the distance of the object
ORIGIN = np.zeros(3)
PARALLEL = 1e6  # condition number of an intersection of parallel rays
FAR = 4.0  # usual distance of cameras, in diagonals of the mesh
FEWEST = 3  # masks needed
SAME_SIZE = 0.15  # log scale that is not reported
SAME_UNIT = 0.05  # log difference of a scale from a quotient of units
STEPS = 3  # corrections of the scale


class MeshSimilarity(NamedTuple):
    """Map x -> scale (x - before) + after of the mesh."""

    scale: float
    before: np.ndarray = ORIGIN
    after: np.ndarray = ORIGIN

    def apply(self, capture: Capture) -> Capture:
        """Return the capture with the mesh moved, and clip planes for it."""
        moved = with_changed_mesh(capture, lambda mesh: replace(
            mesh, positions=self.scale * (mesh.positions - self.before) + self.after
        ))  # fmt: skip
        center, sensors = np.array(moved.shape.bbox().center(), np.float64), []
        for sensor in capture.sensors:
            clip = CLIP * np.linalg.norm(to_world(sensor)[:3, 3] - center)
            sensors.append(changed_sensor(sensor, clip=clip.tolist()))
        return replace(moved, sensors=tuple(sensors))

    @property
    def sentence(self) -> str:
        """Description of a different size; empty if the size is about the same."""
        if abs(np.log(self.scale)) < SAME_SIZE:
            return ""
        factor = min(FACTORS, key=lambda ratio: abs(np.log(self.scale / ratio)))
        is_unit = abs(np.log(self.scale / factor)) < SAME_UNIT
        unit = f"have another unit (--mesh-scale {factor:.4g}), or " if is_unit else ""
        return (
            f" The masks show an object about {self.scale:.2g} times as large as the mesh, which "
            f"may {unit}be in another world than the poses, such as nerfstudio's normalised world "
            "(dataparser_transforms.json)."
        )


def fit_masks(capture: Capture) -> MeshSimilarity | None:
    """Estimate scale and place of the object from its masks in a reduced capture.

    The rays through the centroids of the masks intersect at the object; sizes are compared by the
    area of silhouettes. The rotation is not estimated.
    """
    pairs = zip(capture.used_sensors, compress(capture.masks, capture.used), strict=True)
    shown = {k: (sensor, mask) for k, (sensor, mask) in enumerate(pairs)
             if mask is not None and mask.any()}  # fmt: skip
    if len(shown) < FEWEST:
        return None
    eyes, rays = zip(*(_central_ray(*pair) for pair in shown.values()), strict=True)
    across = [np.eye(3) - np.outer(ray, ray) for ray in rays]
    if np.linalg.cond(sum(across)) > PARALLEL:
        return None
    after = np.linalg.solve(sum(across), sum(map(np.matmul, across, eyes)))
    box = capture.shape.bbox()
    width = float(np.linalg.norm(np.array(box.max - box.min)))
    if not width > 0:
        return None
    distance = float(np.linalg.norm(np.array(eyes) - after, axis=1).mean())
    found = MeshSimilarity(distance / width / FAR, np.array(box.center(), np.float64), after)
    area = sum(mask.sum() for _, mask in shown.values())
    for _ in range(STEPS):
        seen = silhouettes(Thumbnails.of(found.apply(capture)))
        whole = sum(seen[k].sum() for k in shown)
        if not whole:
            return None
        found = found._replace(scale=found.scale * float(np.sqrt(area / whole)))
    return found


def _central_ray(sensor: Any, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the position of a camera, and its unit direction to the centroid of a mask."""
    column, row = np.argwhere(mask).mean(axis=0)[::-1] + 0.5
    x, y = np.array(principal_point(sensor)) - (column, row)
    pose, local = to_world(sensor), np.array([x, y, focal_length(sensor)])
    return pose[:3, 3], pose[:3, :3] @ local / np.linalg.norm(local)

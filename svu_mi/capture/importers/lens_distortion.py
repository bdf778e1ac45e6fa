"""OpenCV's lens distortion and its inverse.

Coordinates are in focal lengths from the principal point, +X right, +Y down. A point at (x, y) in a
pinhole camera is displaced to

    x' = x d + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y d + p1 (r^2 + 2 y^2) + 2 p2 x y         d = 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8

This is Brown's model as in OpenCV, COLMAP, instant-ngp and nerfstudio. k4 is nerfstudio's; OpenCV's
k4 belongs to a rational model, which ``transforms.json`` does not support.
"""

from dataclasses import asdict, dataclass

import numpy as np

COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")  # in nerfstudio's order
STEPS = 50  # of Newton's method; plausible lenses take 3 to 7
EXACT = 1e-12  # relative tolerance of a point, about 1e-8 pixels in any photograph
FRACTIONS = np.linspace(0, 1, 33)[1:]  # of the distance from the centre, tested for folds


@dataclass(frozen=True)
class Lens:
    """Distortion coefficients of a lens."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def record(self) -> dict[str, float]:
        """Coefficients by name, in the order of ``COEFFICIENTS``."""
        return asdict(self)

    def distort(self, points: np.ndarray) -> np.ndarray:
        """Return the displaced positions (..., 2) of pinhole positions (..., 2)."""
        x, y = np.moveaxis(points, -1, 0)
        p1, p2 = self.p1, self.p2
        square, factor, _ = self._radial(x, y)
        return np.stack([
            x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ], axis=-1)  # fmt: skip

    def undistort(self, seen: np.ndarray) -> np.ndarray:
        """Return the inverse of ``distort`` by Newton's method, for points (..., 2).

        A point that does not converge is NaN: it is outside of the image of the lens. If the lens
        folds over, the result is one of several solutions (see ``is_one_to_one``).
        """
        points = np.array(seen, np.float64)
        near = EXACT * (1 + np.abs(points))
        with np.errstate(all="ignore"):  # diverged points become NaN
            for _ in range(STEPS):
                off = self.distort(points) - seen
                if (np.abs(off) < near).all():
                    break
                xx, xy, yy = self._jacobian(points)
                ox, oy = np.moveaxis(off, -1, 0)
                step = np.stack([yy * ox - xy * oy, xx * oy - xy * ox], axis=-1)
                points -= step / (xx * yy - xy * xy)[..., None]
            arrived = (np.abs(self.distort(points) - seen) < near).all(axis=-1)
        points[~arrived] = np.nan
        return points

    def is_one_to_one(self, outline: np.ndarray) -> bool:
        """Return whether all points inside an outline (N, 2) have different displaced positions.

        The outline need not contain the principal point; NaN results in False.
        """
        with np.errstate(all="ignore"):
            xx, xy, yy = self._jacobian(FRACTIONS[:, None, None] * outline)
            return bool((xx * yy - xy * xy > 0).all())

    def _radial(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return r^2, d, and the derivative of d with respect to r^2."""
        square = x * x + y * y
        k1, k2, k3, k4 = self.k1, self.k2, self.k3, self.k4
        factor = 1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))
        return square, factor, k1 + square * (2 * k2 + square * (3 * k3 + square * 4 * k4))

    def _jacobian(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return dx'/dx, dx'/dy = dy'/dx, and dy'/dy."""
        x, y = np.moveaxis(points, -1, 0)
        p1, p2 = self.p1, self.p2
        _, factor, slope = self._radial(x, y)
        return (
            factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
            2 * x * y * slope + 2 * p1 * x + 2 * p2 * y,
            factor + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
        )

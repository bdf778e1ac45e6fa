"""Light above a horizontal plane on which the object stands."""

from dataclasses import replace

import numpy as np

from svu_mi.light.environment import Environment
from svu_mi.light.latlong import directions, quadrature


def above_plane(light: Environment, up: np.ndarray, albedo: float) -> Environment:
    """Return the light above a diffuse plane with unit normal ``up``, which hides other light.

    Its radiance is rho H / pi, with the albedo rho and the irradiance H of the plane. It is
    infinite and as far as the light; the object's shadow on it is neglected.
    """
    rows, columns = light.radiance.shape[:2]
    toward = light.to_local @ up
    height = directions(columns, rows) @ toward
    weight = 2 * np.pi / columns * quadrature(rows)[:, None] * np.maximum(height, 0)
    of_disk = light.disk_directions @ toward
    irradiance = np.einsum("hw,hwc->c", weight, light.radiance)
    irradiance += (light.disk_weights * np.maximum(of_disk, 0)) @ light.disk_radiance
    radiance = np.where(height[..., None] < 0, albedo / np.pi * irradiance, light.radiance)
    disk = np.where(of_disk[:, None] < 0, 0, light.disk_radiance)
    return replace(light, radiance=radiance, disk_radiance=disk)

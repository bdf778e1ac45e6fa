"""Procedural materials of the scenes.

A material is a tuple (base_color (H, W, 3), roughness (H, W), metallic (H, W)) in [0, 1], linear.
"""

from __future__ import annotations

import numpy as np

from svu_mi.scenes.meshes import KNOT_CHARTS, MARGIN

SIZE = 256

Material = tuple[np.ndarray, np.ndarray, np.ndarray]


def coordinates() -> tuple[np.ndarray, np.ndarray]:
    """Return u and v of the texel centres, (H, W) each."""
    center = (np.arange(SIZE) + 0.5) / SIZE
    u, v = np.meshgrid(center, center)
    return u, v


def along(coordinate: np.ndarray, charts: int = 1) -> np.ndarray:
    """Return the position within a chart, in [0, 1]; gutters get values outside [0, 1].

    Patterns of period 1 are continuous across the seam, and continue into the gutters.
    """
    start = np.floor(coordinate * charts) / charts
    return (coordinate - start - MARGIN) / (1 / charts - 2 * MARGIN)


def noise(seed: int, waves: int, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return smooth noise in [0, 1] with period 1, a sum of random plane waves."""
    rng = np.random.default_rng(seed)
    total = np.zeros_like(u)
    for _ in range(24):
        a, b = rng.integers(-waves, waves + 1, 2)
        total += np.cos(2 * np.pi * (a * u + b * v + rng.uniform()))
    low, high = total.min(), total.max()
    return (total - low) / (high - low)


def paint(layers: list[tuple[np.ndarray, tuple[float, float, float], float, float]]) -> Material:
    """Blend layers (mask in [0, 1], colour, roughness, metallic) from first to last."""
    color = np.zeros((SIZE, SIZE, 3))
    rough, metal = np.zeros((SIZE, SIZE)), np.zeros((SIZE, SIZE))
    for mask, paint_color, paint_rough, paint_metal in layers:
        color += mask[..., None] * (np.array(paint_color) - color)
        rough += mask * (paint_rough - rough)
        metal += mask * (paint_metal - metal)
    return color, rough, metal


def planes() -> Material:
    """Return a matte left half and a glossy right half of the same metal.

    The glossy roughness is large enough for 24 views to distinguish it from a perfect mirror.
    """
    u, _ = coordinates()
    one = np.ones_like(u)
    copper = (0.6, 0.42, 0.25)
    return paint([(one, copper, 0.9, 1.0), ((u > 0.5) * one, copper, 0.4, 1.0)])


def spheres() -> Material:
    """Return roughness from 0.1 to 0.85 along a row; the second row is metallic."""
    u, v = coordinates()
    index = (np.floor(v * 4) * 2 + np.floor(u * 2)).astype(int)
    rough = np.array([0.1, 0.3, 0.55, 0.85])[index % 4]
    metal = (index >= 4).astype(float)
    hue = 0.5 + 0.35 * np.cos(2 * np.pi * (index % 4 / 4)[..., None] - np.array([0.0, 2.1, 4.2]))
    return hue, rough, metal


def vase() -> Material:
    """Return clay with blue glaze, painted bands and a golden rim."""
    u, v = coordinates()
    one, u = np.ones_like(u), along(u)
    clay = noise(7341, 9, u, v)

    def band(low: float, high: float) -> np.ndarray:
        return ((v > low) & (v < high)).astype(float)

    wave = 0.70 + 0.035 * np.sin(2 * np.pi * 6 * u)
    dots = ((((u * 12) % 1 - 0.5) ** 2 + ((v - 0.60) * 22) ** 2) < 0.12).astype(float)
    return paint([
        (one, (0.45, 0.25, 0.15), 0.75, 0.0),
        (0.5 * clay, (0.62, 0.42, 0.28), 0.9, 0.0),
        (band(0.44, 1.0) * (v < wave), (0.05, 0.12, 0.42), 0.18, 0.0),
        (band(0.52, 0.55), (0.85, 0.80, 0.70), 0.35, 0.0),
        (dots, (0.90, 0.75, 0.35), 0.25, 1.0),
        (band(0.38, 0.45), (1.00, 0.78, 0.34), 0.2, 1.0),
        (band(0.88, 0.92), (0.30, 0.30, 0.32), 0.45, 1.0),
    ])  # fmt: skip


def knot() -> Material:
    """Return ribbons of brass, lacquer and rubber around the tube, with wear."""
    u, v = coordinates()
    length = (np.floor(v * KNOT_CHARTS) + along(u)) / KNOT_CHARTS
    around = along(v, KNOT_CHARTS)
    ribbon = np.floor(3 * ((around + 8 * length) % 1))
    color, rough, metal = paint([
        (np.ones_like(v), (0.85, 0.62, 0.30), 0.22, 1.0),
        ((ribbon == 1).astype(float), (0.55, 0.04, 0.05), 0.12, 0.0),
        ((ribbon == 2).astype(float), (0.10, 0.12, 0.11), 0.7, 0.0),
    ])  # fmt: skip
    wear = noise(52817, 6, 3 * length, around)
    return color, np.clip(rough + 0.3 * (wear - 0.5), 0.05, 1), metal

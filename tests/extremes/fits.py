"""Stability of the fit (Eq. 12) and of power spectra (Eq. 8): any views, degrees, light."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from oracle import frequency
from oracle.rounding import SPECTRUM

from extremes.cases import Axis, Case, Found, compared, refused
from svu_mi.frequency import fit_sh, power_spectrum
from svu_mi.options import preset

TEXELS = 6
PLACES = ("spread", "identical", "on a line", "in a plane", "grazing", "crowded")


def placed(rng: np.random.Generator, kind: str, texels: int, views: int) -> np.ndarray:
    """Directions to cameras (T, V, 3) above +z, float32."""
    d = rng.normal(size=(texels, views, 3))
    d[..., 2] = np.abs(d[..., 2])
    if kind == "identical":
        d[:] = d[:, :1]
    elif kind == "in a plane":  # through the texel: one great circle
        d[..., 1] = 0
    elif kind == "on a line":  # cameras along a straight track
        d[..., :] = [0.2, 0.1, 1] + 4 * rng.normal(size=(texels, views, 1)) * [1.0, 0.3, 0.05]
        d[..., 2] = np.abs(d[..., 2])
    elif kind == "grazing":  # cos theta = 1e-4
        d[..., 2] = 1e-4 * np.linalg.norm(d[..., :2], axis=-1)
    elif kind == "crowded":  # within a thousandth of a radian
        d = [0.3, 0.2, 1] + 1e-3 * rng.normal(size=d.shape)
    return (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)


def samples(
    seed: int, views: int, kind: str = "spread", channels: int = 3, texels: int = TEXELS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions, weights (cosines) and positive values with a spread of e."""
    rng = np.random.default_rng(seed)
    d = placed(rng, kind, texels, views)
    f = np.exp(rng.normal(size=(texels, views, channels)))
    return d, d[..., 2].copy(), f.astype(np.float32)


def fit_error(
    d: np.ndarray, w: np.ndarray, f: np.ndarray, lmax: int = 6, regularizer: float = 1e-3,
    base: str = "default",
) -> Found:  # fmt: skip
    """Error of every degree's power, as a part of the largest of its texel and channel.

    It may be what ``fit_sh`` promises, and what even double precision loses where the
    equilibrated matrix is close to singular.
    """
    penalized = preset(base).penalize_constant
    truth = frequency.power(frequency.fit(d, w, f, lmax, regularizer, penalized))
    ours = np.array(power_spectrum(fit_sh(d, w, f, lmax, regularizer, base)), np.float64)
    size = np.maximum(truth.max(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    spread = [condition(d[t], w[t], lmax, regularizer, penalized) for t in range(len(d))]
    bounds = SPECTRUM + 4 * (lmax + 1) ** 2 * 2.0**-53 * np.array(spread)
    return compared(ours / size, truth / size,
                    np.broadcast_to(bounds[:, None, None], ours.shape).ravel())  # fmt: skip


def condition(
    d: np.ndarray, w: np.ndarray, lmax: int, regularizer: float, penalized: bool
) -> float:
    """Condition of a texel's normal equations with a diagonal of ones; 0 if it sees nothing."""
    seen = w > 0
    if not seen.any():
        return 0.0
    nothing = np.zeros((int(seen.sum()), 0))
    Y = frequency.basis(d[seen], lmax)
    matrix, _ = frequency.normal_equations(Y, w[seen], nothing, regularizer, penalized)
    scale = 1 / np.sqrt(np.diag(matrix))
    return float(np.linalg.cond(scale[:, None] * matrix * scale))


def _views(_: Path, quick: bool) -> Iterator[Case]:
    counts = (0, 1, 7, 40, 130, 512) if quick else (0, 1, 2, 7, 30, 60, 97, 99, 130, 256, 512)
    for views in counts:
        for kind in PLACES:
            data = samples(1009 + views, views, kind, texels=3 if quick else TEXELS)
            yield f"{views} views, {kind}", partial(_fit, *data)


def _fit(d: np.ndarray, w: np.ndarray, f: np.ndarray) -> Found:
    if d.shape[1] == 0:
        return compared(np.array(fit_sh(d, w, f)), 0.0, 0.0)
    return fit_error(d, w, f)


def _degrees(_: Path, quick: bool) -> Iterator[Case]:
    d, w, f = samples(2003, 40)
    for lmax in (1, 9) if quick else range(1, 10):
        yield f"degree {lmax}", partial(fit_error, d, w, f, lmax)
    yield "degree 10", lambda: refused(lambda: fit_sh(d, w, f, 10))
    yield "preset of degree 10", lambda: refused(lambda: preset("default", degree=10))


def _regularizers(_: Path, quick: bool) -> Iterator[Case]:
    for views, kind in ((7, "spread"), (40, "grazing"), (130, "spread"), (40, "identical")):
        d, w, f = samples(3001, views, kind)
        for power in (-8, 2) if quick else range(-8, 3):
            for base in ("default", "paper"):
                name = f"lambda 1e{power}, {base}, {views} views, {kind}"
                yield name, partial(fit_error, d, w, f, 6, 10.0**power, base)


def _radiance(_: Path, quick: bool) -> Iterator[Case]:
    for views in (20, 130):
        d, w, f = samples(4001, views)
        for power in (-6, 6) if quick else range(-6, 7, 2):
            gain = np.float32(10.0**power)
            yield f"radiance times 1e{power}", partial(fit_error, d, w, f * gain)
        for peak in (4096.0, 1e5, 1e9):
            bright = f.copy()
            bright[:, 3] = peak
            yield f"one sample of {peak:g}", partial(fit_error, d, w, bright)
        yield "black", partial(fit_error, d, w, 0 * f)
        yield "constant", partial(fit_error, d, w, 0 * f + 1)


AGAINST = "power of every degree, as a part of the largest, with a double precision solve"
AXES = (
    Axis("views of a fit", "0 to 512; " + ", ".join(PLACES), AGAINST, _views),
    Axis("degree of a fit", "1 to 9; 10 is refused", AGAINST, _degrees),
    Axis("lambda", "1e-8 to 1e2", AGAINST, _regularizers),
    Axis("radiance of a fit", "1e-6 to 1e6, one sample of 1e9, black", AGAINST, _radiance),
)

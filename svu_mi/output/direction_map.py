"""Map of directions around the object: photographs, candidates, proposals."""

from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.sensors import bounding_sphere, directions_of
from svu_mi.capture.up_direction import up_direction
from svu_mi.guidance.guidance_result import Guidance
from svu_mi.output import style
from svu_mi.output.object_views import viewing_frame
from svu_mi.output.style import FAINT, INK, RULE, UNSEEN

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable

WORST = 0.02  # quantile of the candidates' scores at the lower end of the colours
LUMINANCE, DARK = (0.2126, 0.7152, 0.0722), 0.45  # numbers on darker discs are white


def draw_directions(
    axes: "Axes", capture: Capture, guidance: Guidance, *,
    up: tuple[float, float, float] | None = None, factor: float = 1.0,
) -> "ScalarMappable":  # fmt: skip
    """Draw all candidates on a map of the directions around the object.

    An equal-area map (Hammer projection) seen from outside, with ``up`` (default: that of the
    cameras) at the top; the first photograph is in the middle column. Candidates are dots (hollow
    if unreachable), used photographs are crosses, and proposals have their rank. Colours are
    ``factor`` times the scores.

    Returns:
        ``ScalarMappable`` with the candidates' colours, for ``figure.colorbar``.
    """
    center, _ = bounding_sphere(capture.shape)
    used = directions_of(capture.used_sensors, center)
    frame = viewing_frame(np.array(up or up_direction(capture), np.float64), used[0])
    x, y = _hammer(directions_of(guidance.candidates.sensors, center) @ frame.T)
    gains, reachable = factor * guidance.scores, guidance.candidates.reachable
    low, high = float(np.quantile(gains[reachable], WORST)), float(gains[reachable].max())
    limits = (low, high) if high > low else (low - 1e-6, low + 1e-6)
    drawn = style.scalar_mappable(limits)
    _graticule(axes)
    width = axes.get_position().width * axes.figure.get_size_inches()[0] * 72
    # Dot size at which evenly spread dots do not touch.
    diameter = 0.62 * np.sqrt(4 * np.pi / max(len(gains), 1)) * width / (4.04 * np.sqrt(2))
    size, hollow = float(np.clip(diameter**2, 9, 170)), ~reachable
    axes.scatter(x[hollow], y[hollow], size, facecolors="none", edgecolors=UNSEEN, lw=1)
    colors = drawn.to_rgba(gains[reachable])
    axes.scatter(x[reachable], y[reachable], size, c=colors, lw=0)
    for color, width in (("white", 4.5), (INK, 2.0)):
        axes.scatter(*_hammer(used @ frame.T), 60, c=color, marker="x", lw=width, zorder=3)
    for rank, k in enumerate((one.candidate for one in guidance.proposals), 1):
        draw_numbered(axes, x[k], y[k], rank, drawn.to_rgba(gains[k]), max(size, 230))
    _legend(axes, bool(hollow.any()))
    return drawn


def _hammer(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project (right, up, front) (V, 3) to an ellipse with semi-axes 2 sqrt(2) and sqrt(2)."""
    right, up, front = directions.T
    half, flat = np.arctan2(right, front) / 2, np.sqrt(np.maximum(1 - up**2, 0))
    scale = np.sqrt(2 / (1 + flat * np.cos(half)))
    return 2 * scale * flat * np.sin(half), scale * up


def _graticule(axes: "Axes") -> None:
    """Draw the outline, and lines every 30 degrees of elevation and 45 degrees of azimuth."""
    t = np.linspace(-np.pi, np.pi, 181)

    def line(azimuth: Any, elevation: Any, **options: Any) -> None:
        flat = np.cos(elevation)
        parts = (flat * np.sin(azimuth), np.sin(elevation) + 0 * azimuth, flat * np.cos(azimuth))
        axes.plot(*_hammer(np.stack(parts, axis=-1)), color=RULE, zorder=0, **options)

    edge = np.pi - 1e-6
    for elevation in np.radians([-60, -30, 0, 30, 60]):
        line(np.clip(t, -edge, edge), elevation, lw=1.1 if elevation == 0 else 0.6)
    for azimuth in np.radians([-135, -90, -45, 0, 45, 90, 135]):
        line(azimuth + 0 * t, t / 2, lw=0.6)
    for azimuth in (-edge, edge):
        line(azimuth + 0 * t, t / 2, lw=1.2)
    root = np.sqrt(2)
    axes.set(xlim=(-2.02 * root, 2.02 * root), ylim=(-1.05 * root, 1.05 * root), aspect="equal")
    axes.set_anchor("W")
    axes.set_axis_off()
    axes.text(0, 1.02 * root, "above", size=9.5, color=FAINT, ha="center", va="bottom")
    axes.text(0, -1.02 * root, "below", size=9.5, color=FAINT, ha="center", va="top")


def _legend(axes: "Axes", unreachable: bool) -> None:
    axes.scatter([], [], 60, c=INK, marker="x", lw=2, label="photographs")
    axes.scatter([], [], 90, c="white", edgecolors=INK, lw=1.6, label="proposals by rank")
    axes.scatter([], [], 60, c=[(0.13, 0.57, 0.55)], lw=0, label="other candidates")
    if unreachable:
        axes.scatter([], [], 60, facecolors="none", edgecolors=UNSEEN, label="unreachable")
    style.legend(
        axes, 9.5, loc="lower left", borderaxespad=0, bbox_to_anchor=(-0.01, 1.03),
        handletextpad=0.1, ncol=4, columnspacing=1.4,
    )  # fmt: skip


def draw_numbered(axes: "Axes", x: float, y: float, rank: int, color: Any, size: float,
              **options: Any) -> None:  # fmt: skip
    """Draw a disc with a number."""
    from matplotlib.colors import to_rgb

    ink = INK if np.dot(LUMINANCE, to_rgb(color)) > DARK else "white"
    axes.scatter([x], [y], size, c=[color], edgecolors=INK, lw=1.6, zorder=4, **options)
    axes.text(
        x, y, str(rank), size=9.5, weight="bold", color=ink, ha="center", va="center_baseline",
        zorder=5, **options,
    )  # fmt: skip

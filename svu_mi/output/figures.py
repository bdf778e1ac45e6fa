"""Building blocks of figures, for notebooks and papers: each draws into axes of yours.

```python
figure, axes = plt.subplots(1, 2)
draw_photograph(axes[0], capture, 0)
figure.colorbar(draw_map(axes[1], estimate), ax=axes[1], label="entropy")
```
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.errors import OptionError
from svu_mi.metrics import GroundTruth
from svu_mi.output import views
from svu_mi.output.result import prior_marginal, words
from svu_mi.output.style import COLORMAP, INK, OUTSIDE, UNSEEN, framed
from svu_mi.pipeline import Estimate
from svu_mi.posterior import Posterior
from svu_mi.surface import Texels
from svu_mi.surface.gutter import dilate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.colors import Colormap
    from matplotlib.image import AxesImage

GUTTER = 3  # texels that charts grow by on the object, so that their borders show no seam
KNOWN_WIDTH = 0.05  # at which the only node of a known parameter is drawn
DENSITY, TRUTH = "magma", "#e8453c"  # colours of a posterior, and of the true values


def draw_photograph(axes: Axes, capture: Capture, view: int) -> None:
    """Draw a photograph, exposed for the object and cropped to it.

    Args:
        axes: where to.
        capture: the ``Capture``.
        view: index of the photograph; without a mask all of it is shown.
    """
    mask = capture.masks[view]
    image = views.tone_mapped(capture.images[view], mask)
    if mask is not None:
        image = views.crop(image, views.object_window(mask))
    axes.imshow(image)
    axes.set_axis_off()


def draw_map(
    axes: Axes,
    estimate: Estimate,
    values: Any | None = None,
    *,
    limits: tuple[float, float] = (0, 1),
    colormap: str | Colormap = COLORMAP,
) -> AxesImage:
    """Draw a value of every texel in the layout of the texture; row 0 is v = 0.

    Texels that no view sees are grey, and so light that it is nearly white where there is no
    surface.

    Args:
        axes: where to.
        estimate: says which texels there are and which are seen.
        values: (T,) one value per texel; the entropy by default.
        limits: values at the two ends of the colormap.
        colormap: one of matplotlib's, or its name.

    Returns:
        What was drawn, to hand to ``figure.colorbar``.
    """
    inside, seen = estimate.texels.inside(), estimate.texels.to_image(_seen(estimate), True)
    image = estimate.texels.to_image(_values(estimate, values), np.nan)
    drawn = axes.imshow(image, cmap=colormap, vmin=limits[0], vmax=limits[1])
    cover = np.zeros((*image.shape, 4), np.float32)
    cover[~seen], cover[~inside] = (*UNSEEN, 1), (*OUTSIDE, 1)
    axes.imshow(cover, interpolation="nearest")
    framed(axes)
    return drawn


def draw_on_object(
    axes: Axes,
    capture: Capture,
    estimate: Estimate,
    view: int,
    values: Any | None = None,
    *,
    limits: tuple[float, float] = (0, 1),
    colormap: str = COLORMAP,
) -> None:
    """Draw a value of every texel on the object, as a camera of the capture sees it.

    Args:
        axes: where to.
        capture: the ``Capture``.
        estimate: says which texels there are; those that no view sees are grey.
        view: index of the camera.
        values: (T,) one value per texel; the entropy by default.
        limits: values at the two ends of the colormap.
        colormap: a name of matplotlib's.
    """
    colors = map_colors(estimate, values, limits=limits, colormap=colormap)
    draw_texture(axes, capture, view, colors)


def draw_texture(axes: Axes, capture: Capture, view: int, colors: np.ndarray) -> None:
    """Draw screen colours (H, W, 3) on the object, as a camera of the capture sees it."""
    shown = views.picture(capture, colors, capture.sensors[view])
    axes.imshow(views.crop(shown[..., :3], views.object_window(shown[..., 3] > 0)))
    axes.set_axis_off()


def map_colors(
    estimate: Estimate,
    values: Any | None = None,
    *,
    limits: tuple[float, float] = (0, 1),
    colormap: str | Colormap = COLORMAP,
    gutter: float = GUTTER,
) -> np.ndarray:
    """Return a value of every texel as screen colours (H, W, 3), nearly white outside the charts.

    Args:
        estimate: says which texels there are; those that no view sees are grey.
        values: (T,) one value per texel; the entropy by default.
        limits: values at the two ends of the colormap.
        colormap: one of matplotlib's, or its name.
        gutter: texels that charts grow by.
    """
    from matplotlib import colormaps
    from matplotlib.colors import Normalize

    image = estimate.texels.to_image(_values(estimate, values), limits[0])
    colors = colormaps.get_cmap(colormap)(Normalize(*limits)(image))[..., :3].astype(np.float32)
    inside = estimate.texels.inside()
    colors[~estimate.texels.to_image(_seen(estimate), True)] = UNSEEN
    colors[~inside] = OUTSIDE
    return dilate(colors, inside, gutter)


def all_seen(texels: Texels) -> Any:
    """Return what the functions here take for an estimate that has seen every texel."""
    return SimpleNamespace(texels=texels, coverage=np.ones(texels.count, np.uint32))


def draw_posterior(
    axes: Axes,
    posterior: Posterior,
    texel: int,
    names: tuple[str, str] | None = None,
    *,
    truth: GroundTruth | None = None,
) -> QuadMesh:
    """Draw the posterior of one texel over two parameters (Fig. 4 of the paper).

    Any other parameter is marginalised; of three colour channels the mean is shown.

    Args:
        axes: where to.
        posterior: of all texels.
        texel: index of the texel.
        names: the parameters along x and y; by default the first two of ``posterior.axes``,
            known ones last.
        truth: true parameters of all texels, to mark with a cross.

    Returns:
        What was drawn, to hand to ``figure.colorbar``; colours end at 0 and the largest p.

    Raises:
        OptionError: an unknown parameter, twice the same, or a texel that does not exist.
    """
    order = list(posterior.axes)
    x, y = names or sorted(order, key=lambda name: len(posterior.axes[name]) == 1)[:2]
    if x == y or not {x, y} <= set(order):
        raise OptionError(f"draw_posterior(): expected two of {', '.join(order)}, got {x}, {y}.")
    p = np.array(posterior.probabilities_of([texel]), np.float64)[0]
    p = p.reshape(*posterior.grid.shape, posterior.groups).mean(axis=-1)
    p = p.sum(axis=tuple(k for k, name in enumerate(order) if name not in (x, y)))
    if order.index(x) < order.index(y):
        p = p.T  # rows along y
    edges_x, edges_y = cell_edges(posterior.axes[x]), cell_edges(posterior.axes[y])
    drawn = axes.pcolormesh(edges_x, edges_y, p, cmap=DENSITY, vmin=0, vmax=p.max())
    if truth is not None:
        point = [truth.grey(name)[texel] for name in (x, y)]
        axes.plot(*point, "x", color="white", ms=9, mew=4, clip_on=False)
        axes.plot(*point, "x", color=TRUTH, ms=8, mew=2, clip_on=False)
    axes.set(xlabel=_words(x), ylabel=_words(y), xticks=[0, 0.5, 1], yticks=[0, 0.5, 1])
    return drawn


def draw_marginal(
    axes: Axes, posterior: Posterior, texel: int, name: str, *, truth: GroundTruth | None = None
) -> None:
    """Draw the marginal of one parameter of one texel as bars, one per node of the grid.

    Of three colour channels the mean is shown. Dashed is where nobody looked.

    Args:
        axes: where to.
        posterior: of all texels.
        texel: index of the texel.
        name: a name of ``posterior.axes``.
        truth: true parameters of all texels, to mark with a line.

    Raises:
        OptionError: an unknown parameter, or a texel that does not exist.
    """
    p = np.array(posterior.marginal(name, [texel]), np.float64)
    nodes = posterior.axes[name]
    heights = p.reshape(len(nodes), -1).mean(axis=1)
    edges = cell_edges(nodes)
    axes.bar(edges[:-1], heights, 0.9 * np.diff(edges), align="edge", color=INK, alpha=0.75)
    axes.plot(nodes, prior_marginal(posterior, name), color=INK, lw=1, ls=(0, (2, 2)))
    if truth is not None:
        axes.axvline(truth.grey(name)[texel], color=TRUTH, lw=2)
    axes.set(xlabel=_words(name), ylim=(0, 1), xlim=(edges[0], edges[-1]), xticks=[0, 0.5, 1])
    axes.spines[["top", "right"]].set_visible(False)


def _seen(estimate: Estimate) -> np.ndarray:
    return np.array(estimate.coverage) > 0


def _values(estimate: Estimate, values: Any | None) -> np.ndarray:
    return np.array(estimate.entropy if values is None else values).astype(np.float32)


def cell_edges(nodes: np.ndarray) -> np.ndarray:
    """Borders of cells around the nodes: half-way, and mirrored at both ends."""
    if len(nodes) == 1:  # of a parameter that is known
        return nodes[0] + np.array([-KNOWN_WIDTH, KNOWN_WIDTH]) / 2
    middle = (nodes[1:] + nodes[:-1]) / 2
    return np.concatenate([[2 * nodes[0] - middle[0]], middle, [2 * nodes[-1] - middle[-1]]])


def _words(name: str) -> str:
    return "specular (Ks)" if name == "specular" else words(name)

"""Panels of pages, notebooks and papers: each function draws into given axes.

```python
figure, axes = plt.subplots(1, 2)
draw_photograph(axes[0], capture, 0)
figure.colorbar(draw_map(axes[1], estimate), ax=axes[1], label="entropy")
```

The argument ``estimate`` provides texels and coverage. ``values`` are numbers per texel (T,), by
default the entropy; ``limits`` are the values at the ends of the colormap.
"""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.tonemap import ObjectView, object_only_scene, srgb, tone_mapped, with_bounds
from svu_mi.errors import OptionError
from svu_mi.geometry.dilate import dilate
from svu_mi.geometry.texels import Texels
from svu_mi.output import object_views, style
from svu_mi.output.estimate_arrays import is_seen, label_of, prior_marginal
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.posterior import Posterior

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.colorbar import Colorbar
    from matplotlib.colors import Colormap
    from matplotlib.image import AxesImage

    from svu_mi.evaluation.ground_truth import GroundTruth

TALL = 1.5  # ratio of height to width
GUTTER = 3  # dilation of the charts in texels, to hide seams on the object
KNOWN_WIDTH = 0.05  # bar width of a known parameter, which has a single node


def draw_photograph(
    axes: "Axes", capture: Capture, view: int, window: object_views.Window | None = None
) -> None:
    """Draw a photograph, exposed for the object and cropped to ``window`` (default: its mask)."""
    mask = capture.masks[view] if capture.masks else None
    image = tone_mapped(with_bounds(capture, view), mask)
    if window is None and mask is not None:
        window = object_views.object_window(mask)
    style.draw_image(axes, image if window is None else object_views.crop(image, window))


def draw_map(
    axes: "Axes",
    estimate: Estimate,
    values: Any | None = None,
    *,
    limits: tuple[float, float] = (0, 1),
    colormap: "str | Colormap" = style.COLORMAP,
    interpolation: str | None = None,
) -> "AxesImage":
    """Draw a value of every texel in the layout of the texture; row 0 is v = 0.

    Unseen texels are grey; pixels without surface are nearly white. ``interpolation`` is passed to
    ``imshow``.

    Returns:
        The image, for ``figure.colorbar``.
    """
    inside, seen = estimate.texels.inside(), estimate.texels.to_image(is_seen(estimate), True)
    image = estimate.texels.to_image(_values(estimate, values), np.nan)
    drawn = axes.imshow(
        image, cmap=colormap, vmin=limits[0], vmax=limits[1], interpolation=interpolation
    )
    cover = np.zeros((*image.shape, 4), np.float32)
    cover[~seen], cover[~inside] = (*style.UNSEEN, 1), (*style.OUTSIDE, 1)
    axes.imshow(cover, interpolation="nearest")
    style.frame_map(axes)
    return drawn


def draw_scaled_map(
    axes: "Axes", estimate: Estimate, values: Any | None = None, label: str = "", *,
    ticks: Sequence[float] = (), **options: Any,
) -> "Colorbar":  # fmt: skip
    """Draw a map (see ``draw_map`` for ``options``) with a colour bar below, or beside a tall one.

    ``ticks`` are the labelled values of the bar; default: matplotlib's.
    """
    drawn = draw_map(axes, estimate, values, **options)
    height, width = estimate.texels.inside().shape
    place = (1.2, 0, 0.05 * height / width, 0.75) if is_tall(estimate) else style.BELOW
    bar: Colorbar = style.color_bar(axes, drawn, label, place, ticks=ticks)
    return bar


def is_tall(estimate: Estimate) -> bool:
    """Return whether maps are so narrow that their legends have more room beside them."""
    height, width = estimate.texels.inside().shape
    return height > TALL * width


def draw_on_object(
    axes: "Axes", capture: Capture, estimate: Estimate, view: int, values: Any | None = None,
    **options: Any,
) -> None:  # fmt: skip
    """Draw a value of every texel on the object, from a camera (``options``: ``map_colors``)."""
    look = ObjectView.at(object_only_scene(capture), capture.sensors[view])
    draw_look(axes, look, map_colors(estimate, values, **options))


def draw_look(axes: "Axes", look: ObjectView, colors: np.ndarray) -> None:
    """Draw the view ``look`` of the object, textured with screen colours (H, W, 3), cropped."""
    shown = look.painted(colors)
    style.draw_image(
        axes, object_views.crop(shown[..., :3], object_views.object_window(shown[..., 3] > 0))
    )


def map_colors(
    estimate: Estimate, values: Any | None = None, *, limits: tuple[float, float] = (0, 1),
    colormap: "str | Colormap" = style.COLORMAP, gutter: float = GUTTER,
) -> np.ndarray:  # fmt: skip
    """Return a value of every texel as screen colours (H, W, 3), nearly white outside the charts.

    Charts are dilated by ``gutter`` texels.
    """
    colors = style.colors(_values(estimate, values), limits, colormap)
    return _laid_out(estimate, colors, gutter, style.UNSEEN)


def albedo_colors(
    estimate: Estimate, values: Any, *, gutter: float = GUTTER, unseen: Any = style.UNSEEN
) -> np.ndarray:
    """Return linear colours of texels (T, 3) as screen colours (H, W, 3), as in ``map_colors``.

    ``unseen`` is a colour (3,) or an image (H, W, 3) for unseen texels.
    """
    colors = srgb(np.clip(np.array(values), 0, 1))
    return _laid_out(estimate, colors, gutter, unseen)


def _laid_out(estimate: Estimate, colors: np.ndarray, gutter: float, unseen: Any) -> np.ndarray:
    """Lay screen colours (T, 3) out as a texture with a gutter."""
    image, inside = estimate.texels.to_image(colors, 0), estimate.texels.inside()
    not_seen = ~estimate.texels.to_image(is_seen(estimate), True)
    image[not_seen] = np.broadcast_to(unseen, image.shape)[not_seen]
    image[~inside] = style.OUTSIDE
    return dilate(image, inside, gutter)


def fully_seen(texels: Texels) -> Any:
    """Return texels and coverage as in an estimate, with every texel seen once."""
    return SimpleNamespace(texels=texels.layout, coverage=np.ones(texels.count, np.uint32))


def draw_posterior(
    axes: "Axes",
    posterior: Posterior,
    texel: int,
    names: tuple[str, str] | None = None,
    *,
    truth: "GroundTruth | None" = None,
) -> "QuadMesh":
    """Draw the posterior of one texel over two parameters (Fig. 4 of the paper).

    Other parameters are marginalised, and three colour channels are averaged. Colours range from 0
    to the largest probability.

    Args:
        axes: Axes to draw into.
        posterior: Posterior of T texels.
        texel: Index of the texel.
        names: Parameters of x and y; default: the first two unknown ones.
        truth: True parameters of all texels, to mark with a cross.

    Raises:
        OptionError: a parameter is unknown or repeated, or the texel does not exist.
    """
    order = list(posterior.axes)
    x, y = names or sorted(order, key=lambda name: len(posterior.axes[name]) == 1)[:2]
    if x == y or not {x, y} <= set(order):
        raise OptionError(f"draw_posterior(): expected two of {', '.join(order)}, got {x}, {y}.")
    p = np.array(posterior.probabilities_of([texel]), np.float64)[0]
    p = p.reshape(*posterior.grid.shape, posterior.channels).mean(axis=-1)
    p = p.sum(axis=tuple(k for k, name in enumerate(order) if name not in (x, y)))
    if order.index(x) < order.index(y):
        p = p.T  # rows along y
    edges_x, edges_y = bar_edges(posterior.axes[x]), bar_edges(posterior.axes[y])
    drawn = axes.pcolormesh(edges_x, edges_y, p, cmap=style.DENSITY_COLORMAP, vmin=0, vmax=p.max())
    if truth is not None:
        point = [truth.grey(name)[texel] for name in (x, y)]
        axes.plot(*point, "x", color="white", ms=9, mew=4, clip_on=False)
        axes.plot(*point, "x", color=style.MARK, ms=8, mew=2, clip_on=False)
    axes.set(xlabel=_axis_label(x), ylabel=_axis_label(y), xticks=[0, 0.5, 1], yticks=[0, 0.5, 1])
    return drawn


def draw_marginal(
    axes: "Axes", posterior: Posterior, texel: int, name: str, *, truth: "GroundTruth | None" = None
) -> None:
    """Draw the marginal of one parameter of one texel as bars, one per node of the grid.

    Three colour channels are averaged. The dashed line is the prior; a vertical line marks the
    value in ``truth``, the true parameters of all texels.

    Raises:
        OptionError: the parameter is unknown, or the texel does not exist.
    """
    p = np.array(posterior.marginal(name, [texel]), np.float64)
    nodes = posterior.axes[name]
    heights = p.reshape(len(nodes), -1).mean(axis=1)
    edges = bar_edges(nodes)
    axes.bar(edges[:-1], heights, 0.9 * np.diff(edges), align="edge", color=style.INK, alpha=0.75)
    axes.plot(nodes, prior_marginal(posterior, name), color=style.INK, lw=1, ls=(0, (2, 2)))
    if truth is not None:
        axes.axvline(truth.grey(name)[texel], color=style.MARK, lw=2)
    axes.set(xlabel=_axis_label(name), ylim=(0, 1), xlim=(edges[0], edges[-1]), xticks=[0, 0.5, 1])
    axes.spines[["top", "right"]].set_visible(False)


def bar_edges(nodes: np.ndarray) -> np.ndarray:
    """Return the edges of bars around nodes: midpoints, mirrored at both ends."""
    if len(nodes) == 1:  # known parameter
        return nodes[0] + np.array([-KNOWN_WIDTH, KNOWN_WIDTH]) / 2
    middle = (nodes[1:] + nodes[:-1]) / 2
    return np.concatenate([[2 * nodes[0] - middle[0]], middle, [2 * nodes[-1] - middle[-1]]])


def _values(estimate: Estimate, values: Any | None) -> np.ndarray:
    return np.array(estimate.entropy if values is None else values).astype(np.float32)


def _axis_label(name: str) -> str:
    return "specular (Ks)" if name == "specular" else label_of(name)

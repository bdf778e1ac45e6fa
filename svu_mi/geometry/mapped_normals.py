"""Shading normals of texels under a ``normalmap`` or ``bumpmap``."""

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.capture.normal_map import scale_of, texture_of
from svu_mi.capture.scene import last_sentence
from svu_mi.errors import MeshError, excerpt

MOST = 4  # samples of the map along each side of a texel


def mapped_normals(
    layer: Any, normal: Any, geometric_normal: Any, sides: tuple[Any, Any], uv: Any,
    resolution: tuple[int, int], label: str,
) -> Any:  # fmt: skip
    """Return the mean shading normals (Normal3f) of texels with a ``normalmap`` or ``bumpmap``."""
    along = sides[0] * resolution[0], sides[1] * resolution[1]
    texture, of_height = texture_of(layer), layer.class_name() == "BumpMap"
    frame = tangent_frame(normal, along[0])

    def read(si: Any) -> Any:
        if of_height:
            return _bumped(scale_of(layer) * texture.eval_1_grad(si), normal, along)
        return frame.to_world(dr.normalize(mi.Vector3f(2 * texture.eval_3(si) - 1)))

    try:
        # The slope jumps at the centres of pixels.
        places = _places(texture, uv, resolution, 2 if of_height else 1)
        total = sum((read(si) for si in places), mi.Vector3f(0))
        mapped = dr.normalize(total)
        if of_height:
            mapped = dr.mulsign(mapped, dr.dot(geometric_normal, mapped))
        dr.eval(mapped)
    except RuntimeError as error:
        raise MeshError(
            f"{label}: its normal or bump map cannot be read "
            f"({excerpt(last_sentence(str(error)), 120)}); use a bitmap, of three channels for "
            "normals and of one for heights."
        ) from error
    return mi.Normal3f(dr.select(dr.all(dr.isfinite(mapped)), mapped, mi.Vector3f(normal)))


def tangent_frame(normal: Any, along: Any) -> Any:
    """Return the frame (Frame3f) of a normal map; ``along`` is the direction of u."""
    frame = mi.Frame3f(normal)
    frame.s = dr.normalize(along - normal * dr.dot(normal, along))
    frame.t = dr.cross(normal, frame.s)
    return frame


def _places(texture: Any, uv: Any, resolution: tuple[int, int], finer: int) -> Iterator[Any]:
    """Yield interactions at points that divide each texel as the texture does, or finer."""
    columns, rows = (
        min(MOST, finer * max(1, size // texels))
        for size, texels in zip(texture.resolution(), resolution, strict=True)
    )
    for place in range(columns * rows):
        step = (place % columns + 0.5) / columns - 0.5, (place // columns + 0.5) / rows - 0.5
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
        si.uv = uv + mi.Point2f(step[0] / resolution[0], step[1] / resolution[1])
        yield si


def _bumped(slope: Any, normal: Any, along: tuple[Any, Any]) -> Any:
    """Return the normal, up to its sign, of a surface that heights of a slope displace."""
    u, v = (
        mi.Vector3f(side + normal * (rise - dr.dot(normal, side)))
        for side, rise in zip(along, slope, strict=True)
    )
    return dr.normalize(dr.cross(u, v))

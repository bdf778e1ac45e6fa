"""Charts of an asset: what lies inside them, gutters around them, and means at vertices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from svu_mi.capture.mesh import make
from svu_mi.errors import CaptureError
from svu_mi.export.asset import Asset
from svu_mi.output.maps import GUTTER
from svu_mi.recovery.textures import Textures
from svu_mi.surface import Texels, texels
from svu_mi.surface.gutter import dilate
from svu_mi.surface.layout import barycentric

Layouts = dict[tuple[int, ...], Texels]
"""Texels by (H, W)."""

UNKNOWN = {"entropy": 1.0, "coverage": 0.0}  # where there is no surface
COINCIDENT = 1e-6  # of the mesh's extent: vertices that close are at one point
STRAY_LIMIT = 0.02  # part of the seen texels that may lie where the mesh has no chart


def charts(asset: Asset) -> Layouts:
    """Lay texels out at the (H, W) of the textures, and of the maps if that is another.

    Raises:
        MeshError: the UVs cannot carry texels.
        CaptureError: the maps belong to other UVs.
    """
    mesh = make(asset.name, asset.mesh)
    width, height = asset.textures.resolution
    sizes = {(height, width), *(image.shape for image in asset.maps.values())}
    laid_out = {size: texels(mesh, (size[1], size[0])) for size in sizes}
    if asset.coverage is not None:
        inside = laid_out[asset.coverage.shape].inside()
        near = dilate(inside, inside, GUTTER + 1)
        seen = asset.coverage > 0
        if (seen & ~near).sum() > STRAY_LIMIT * seen.sum():
            raise CaptureError(
                f"'{asset.name}': coverage and entropy lie beside the charts of the mesh, so they "
                "belong to other UVs; compute them on the capture that the textures are of."
            )
    return laid_out


def with_gutters(asset: Asset, laid_out: Layouts, width: int | None) -> Asset:
    """Give texels outside the charts the value of the nearest one inside.

    Args:
        asset: the asset.
        laid_out: its ``charts``.
        width: of the gutter in texels; None is as far as it goes. Beyond it textures stay as they
            are, entropy is 1 and coverage 0.
    """
    images = {name: np.array(tensor) for name, tensor in asset.textures.items()}
    filled = {}
    for name, image in {**images, **asset.maps}.items():
        inside = laid_out[image.shape[:2]].inside()
        if name in UNKNOWN:
            image = np.where(inside, image, np.float32(UNKNOWN[name]))
        reach = float(np.hypot(*inside.shape)) if width is None else width
        filled[name] = dilate(image, inside, reach)
    textures = Textures.of({name: filled.pop(name) for name in images})
    entropy, coverage = filled.get("entropy"), filled.get("coverage")
    return replace(asset, textures=textures, entropy=entropy, coverage=coverage)


def at_vertices(asset: Asset, laid_out: Texels, image: np.ndarray) -> np.ndarray:
    """Average a map around every vertex.

    A texel counts for the three vertices of its face, by its area and barycentric coordinates:
    the L2 projection onto linear elements with a lumped mass matrix. Vertices at the same point,
    as along the border of a chart, get the same value.

    Args:
        asset: the asset.
        laid_out: its texels at the resolution of the image.
        image: (H, W), gutters filled.

    Returns:
        (N,) float32.
    """
    mesh = asset.mesh
    assert mesh.uvs is not None
    corners = mesh.faces[np.array(laid_out.face)]
    weights = barycentric(mesh.uvs[corners], np.array(laid_out.uv, np.float64).T)
    weights *= np.array(laid_out.footprint, np.float64)[:, None] ** 2
    values = weights * image.reshape(-1)[np.array(laid_out.index), None]
    steps = np.rint(mesh.positions / (COINCIDENT * laid_out.extent)).astype(np.int64)
    point = np.unique(steps, axis=0, return_inverse=True)[1].reshape(-1)
    weight, total = (
        np.bincount(point[corners].ravel(), each.ravel(), len(point))[point]
        for each in (weights, values)
    )
    # A face may be too small for a texel: what is under the vertex itself must do.
    height, width = image.shape
    column, row = np.clip(mesh.uvs * (width, height), 0, (width - 1, height - 1)).astype(int).T
    found = np.where(weight > 0, total / np.where(weight > 0, weight, 1), image[row, column])
    return found.astype(np.float32)

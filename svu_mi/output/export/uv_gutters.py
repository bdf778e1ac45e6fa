"""UV charts of an asset: inside test, gutters, and means of maps at vertices."""

from dataclasses import replace

import numpy as np

from svu_mi.capture.mesh import MeshArrays, make_mesh
from svu_mi.capture.uv_charts import rasterize
from svu_mi.errors import CaptureError, MeshError
from svu_mi.geometry.dilate import dilate
from svu_mi.geometry.texels import barycentric, texels
from svu_mi.output.export.asset import SD, Asset
from svu_mi.output.maps import GUTTER
from svu_mi.parameters import NAMES
from svu_mi.recovery.svbrdf_textures import Textures

UNKNOWN = {"entropy": 1.0, "coverage": 0.0} | {name + SD: 0.0 for name in NAMES}  # outside charts
COINCIDENT = 1e-6  # distance of vertices at the same point, relative to the mesh's extent
STRAY_LIMIT = 0.02  # largest fraction of the seen texels outside the mesh's charts


def with_gutters(asset: Asset, width: int | None) -> Asset:
    """Fill texels outside the charts with the nearest value inside.

    ``width`` is the largest distance in texels; None is unlimited. At larger distances, textures
    keep their values, entropy is 1, and other maps are 0. Raises a ``CaptureError`` if the maps
    were computed for other UVs.
    """
    images = {name: np.array(tensor) for name, tensor in asset.textures.items()}
    shapes = [image.shape[:2] for image in (*images.values(), *asset.maps.values())]
    inside = {shape: inside_charts(asset, shape) for shape in dict.fromkeys(shapes)}
    if asset.coverage is not None:
        valid, seen = inside[asset.coverage.shape], asset.coverage > 0
        if (seen & ~dilate(valid, valid, GUTTER + 1)).sum() > STRAY_LIMIT * seen.sum():
            raise CaptureError(
                f"'{asset.name}': coverage and entropy lie outside the charts of the mesh, so they "
                "belong to other UVs; compute them from the textures' capture."
            )
    filled = {}
    for name, image in {**images, **asset.maps}.items():
        valid = inside[image.shape[:2]]
        if name in UNKNOWN:
            image = np.where(valid, image, np.float32(UNKNOWN[name]))
        filled[name] = dilate(
            image, valid, float(np.hypot(*valid.shape)) if width is None else width
        )
    textures = Textures.of({name: filled.pop(name) for name in images})
    entropy, coverage = filled.get("entropy"), filled.get("coverage")
    deviations = {name: filled[name + SD] for name in asset.deviations}
    return replace(
        asset, textures=textures, entropy=entropy, coverage=coverage, deviations=deviations
    )


def inside_charts(asset: Asset, shape: tuple[int, int]) -> np.ndarray:
    """Return (H, W) bool, True for texel centres on a chart; raise MeshError if all are False."""
    height, width = shape
    assert asset.mesh.uvs is not None
    count = rasterize(asset.mesh.uvs[asset.mesh.faces], (width, height))[1]
    if not count.any():
        raise MeshError(
            f"'{asset.name}': no texel of a {width} x {height} texture lies on a chart; check that "
            "the UVs are in the unit square."
        )
    return count.reshape(height, width) > 0


def at_vertices(mesh: MeshArrays, image: np.ndarray) -> np.ndarray:
    """Return local means of a map (H, W) with gutters at the N vertices, (N,) float32.

    Texels contribute to the three vertices of their face, weighted by area and barycentric
    coordinates: the L2 projection onto linear elements with a lumped mass matrix. Vertices with
    the same position, as along chart borders, get the same value.
    """
    assert mesh.uvs is not None
    height, width = image.shape
    laid_out = texels(make_mesh("mesh", mesh), (width, height))
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
    # Faces without a texel centre: use the texel under the vertex.
    column, row = np.clip(mesh.uvs * (width, height), 0, (width - 1, height - 1)).astype(int).T
    means = np.where(weight > 0, total / np.where(weight > 0, weight, 1), image[row, column])
    return means.astype(np.float32)

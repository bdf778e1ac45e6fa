"""``Asset``: mesh, textures and uncertainty of an object."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.content_hash import capture_key
from svu_mi.capture.mesh import MeshArrays, arrays, check_buffers
from svu_mi.capture.normal_map import MIRRORED, mirrored_share, normal_map, texture_of
from svu_mi.capture.replace_material import is_same, is_two_sided
from svu_mi.capture.up_direction import up_direction
from svu_mi.core.identifiers import plain_name
from svu_mi.core.io.schema import LARGEST
from svu_mi.errors import MeshError, OptionError, ShapeError
from svu_mi.output.maps import padded_image
from svu_mi.output.object_views import Up, named_up
from svu_mi.recovery.svbrdf_textures import Textures

TEXTURES, RECORD = "textures", "asset.json"  # folder and file of an export
SD = "_sd"  # suffix of maps with standard deviations


@dataclass(frozen=True, kw_only=True)
class Asset:
    """Mesh with textures of the ``principled`` BSDF, in the world space of its capture.

    Attributes:
        name: Name of the object in all files; converted to one printable line.
        mesh: Mesh with UVs in the unit square; v = 0 is the first row of an image.
        textures: Recovered textures.
        entropy: (H, W) float32 in [0, 1], any resolution; None if unknown.
        coverage: (H, W) float32 number of views, same resolution as ``entropy``; None if unknown.
        deviations: (H, W) float32 standard deviations by parameter, in the textures' resolution;
            for base colour the largest of its channels.
        normals: (H, W, 3) float32 in [0, 1], normal map of the object, any resolution; None without
            one, and if its UVs are mirrored: tangents of other programs differ there.
        two_sided: Whether back faces reflect light, too.
        up: Upward axis of the world, ``y`` or ``z``, or its upward direction.
        source: Origin of the data, for the record.
        capture: Digest of the capture; empty if unknown.

    Example:
        >>> asset = svu.Asset.of(capture, recovery, estimate)
        >>> sorted(asset.maps)
        ['coverage', 'entropy']
        >>> asset.entropy.shape
        (64, 64)
    """

    name: str
    mesh: MeshArrays
    textures: Textures
    entropy: np.ndarray | None = None
    coverage: np.ndarray | None = None
    deviations: Mapping[str, np.ndarray] = field(default_factory=dict)
    normals: np.ndarray | None = None
    two_sided: bool = False
    up: Up = "y"
    source: str | None = None
    capture: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", plain_name(self.name))
        _check_mesh(self.name, self.mesh)
        for name, tensor in self.textures.items():
            _check_values(name, np.array(tensor), 1)
        for name, image in self.maps.items():
            if image.ndim != 2 or not image.size:
                raise ShapeError(f"Asset: {name} must have shape (H, W), got {image.shape}.")
            _check_values(name, image, np.inf if name == "coverage" else 1)
        both = (self.entropy, self.coverage)
        shapes = [str(image.shape) for image in both if image is not None]
        if len(set(shapes)) > 1:
            raise ShapeError(
                f"Asset: entropy and coverage differ in size, {' and '.join(shapes)}; give maps of "
                "one estimate."
            )

    @property
    def maps(self) -> dict[str, np.ndarray]:
        """Available maps by name: entropy, coverage, ``roughness_sd``, ..."""
        maps = {"entropy": self.entropy, "coverage": self.coverage}
        there = {name: image for name, image in maps.items() if image is not None}
        return there | {name + SD: image for name, image in self.deviations.items()}

    @classmethod
    def of(
        cls, capture: Any, recovery: Any, estimate: Any | None = None, field: Any | None = None
    ) -> "Asset":
        """Return an asset from results in memory; the estimate may have another resolution."""
        seen = recovery if estimate is None else estimate
        entropy, deviations = None, {}
        if estimate is not None:
            entropy = padded_image(seen, np.array(estimate.entropy, np.float32))
        if field is not None:
            deviations = {
                name: padded_image(field, largest_channel(field.sd(name)), fill=0)
                for name in field.names
            }
        return cls(
            name=capture.shape.id() or "object",
            mesh=arrays(capture.mesh),
            textures=recovery.textures,
            entropy=entropy,
            coverage=padded_image(seen, np.asarray(seen.coverage).astype(np.float32), fill=0),
            deviations=deviations,
            normals=_normals_of(capture),
            two_sided=is_two_sided(capture.shape.bsdf()),
            up=named_up(up_direction(capture)),
            source=capture.source,
            capture=capture_key(capture),
        )


@dataclass(frozen=True, kw_only=True)
class AssetFile:
    """File of an asset: relative path, format, content, and encoding of its values."""

    file: str
    format: str
    holds: str
    values: str


def _normals_of(capture: Any) -> np.ndarray | None:
    """Return the pixels of the object's normal map, if other programs can use it."""
    layer = normal_map(capture.shape.bsdf())
    if layer is None or not is_same(capture.mesh, capture.shape):
        return None
    params = mi.traverse(texture_of(layer))
    plain = "data" in params and np.allclose(params["to_uv"].matrix, np.eye(3))
    if not plain or layer.class_name() != "NormalMap":
        return None
    return usable_normals(np.array(params["data"]), arrays(capture.mesh))


def usable_normals(pixels: np.ndarray, mesh: MeshArrays) -> np.ndarray | None:
    """Return a normal map in [0, 1], or None if UVs are mirrored."""
    if mirrored_share(mesh) > MIRRORED:
        return None
    unit = 255 if pixels.dtype == np.uint8 else 1
    return np.clip(np.asarray(pixels, np.float32) / unit, 0, 1)


def largest_channel(deviations: np.ndarray) -> np.ndarray:
    """Return the maximum over channels of values (T, C) or (T,), as (T,) float32."""
    table = np.asarray(deviations, np.float32)
    return np.asarray(table.reshape(len(table), -1).max(axis=1, initial=0))


def _check_mesh(name: str, mesh: MeshArrays) -> None:
    if mesh.uvs is None:
        raise MeshError(f"'{name}' has no UVs for its textures; unwrap it first.")
    if not len(mesh.faces):
        raise MeshError(f"'{name}' has no triangles.")
    check_buffers(mesh, f"'{name}'", MeshError, LARGEST)


def _check_values(name: str, image: np.ndarray, maximum: float) -> None:
    bad = int((~((image >= 0) & (image <= maximum) & np.isfinite(image))).sum())
    if bad:
        raise OptionError(
            f"Asset: {bad} values of {name} are NaN or outside [0, {maximum:g}]; clip them."
        )

"""Normal and bump maps of the object: BSDFs that tilt the normal of the BSDF within them."""

from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.mesh import MeshArrays, chart_areas

MAPS = {"NormalMap": "normalmap", "BumpMap": "bumpmap"}  # type in XML by class
MIRRORED = 0.001  # share of the UV area from which tangents of glTF differ
WRAPPERS = ("TwoSidedBRDF", "MaskBSDF", *MAPS)


def layers(bsdf: Any) -> list[Any]:
    """Return a BSDF and those within its wrappers, from the outside; the front of two sides."""
    found = [bsdf]
    while found[-1] is not None and found[-1].class_name() in WRAPPERS:
        found.append(_children(found[-1], mi.BSDF)[0])
    return found


def normal_map(bsdf: Any) -> Any | None:
    """Return the ``normalmap`` or ``bumpmap`` among the layers of a BSDF."""
    return next((each for each in layers(bsdf) if each and each.class_name() in MAPS), None)


def texture_of(layer: Any) -> Any:
    """Return the texture of a normal or bump map."""
    return _children(layer, mi.Texture)[0]


def scale_of(layer: Any) -> float:
    """Return the factor of a bump map's heights; 1 for a normal map."""
    params = mi.traverse(layer)
    return float(params["scale"]) if "scale" in params else 1.0


def with_normal_map(layer: Any | None, material: Any) -> Any:
    """Return a BSDF, within a normal or bump map like ``layer``, if there is one."""
    if layer is None:
        return material
    kind, scale = MAPS[layer.class_name()], scale_of(layer)
    own = {"normalmap": texture_of(layer)} if kind == "normalmap" else {
        "heights": texture_of(layer), "scale": scale,
    }  # fmt: skip
    return mi.load_dict({"type": kind, **own, "material": material})


def _children(parent: Any, kind: type) -> list[Any]:
    tree = mi.traverse(parent).hierarchy
    return [node for node, (above, _) in tree.items() if above is parent and isinstance(node, kind)]


def mirrored_share(mesh: MeshArrays) -> float:
    """Return the share of UV area that shows a mirrored picture; V = 0 is its first row."""
    assert mesh.uvs is not None
    area = chart_areas(mesh.uvs, mesh.faces, signed=True)
    return float(np.maximum(area, 0).sum() / max(np.abs(area).sum(), 1e-300))

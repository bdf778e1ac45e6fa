"""Normal maps of glTF, if Mitsuba's ``normalmap`` has the same tangents."""

from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture.importers.mesh_materials import MAX_PIXELS, header_of


def normal_picture(path: Path, visual: Any) -> np.ndarray | None:
    """Return the normal map of a glTF's only material, (H, W, 3) bytes; None without a usable one.

    It must use the UVs of the base colour, without scale or extensions.
    """
    picture = getattr(getattr(visual, "material", None), "normalTexture", None)
    with_maps = [m for m in header_of(path).get("materials", ()) if "normalTexture" in m]
    if picture is None or len(with_maps) != 1 or picture.width * picture.height > MAX_PIXELS:
        return None
    entry = with_maps[0]["normalTexture"]
    base = with_maps[0].get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
    if entry.get("texCoord", 0) != base.get("texCoord", 0) or entry.get("scale", 1) != 1:
        return None
    if "extensions" in entry or "extensions" in base:
        return None
    return np.array(picture.convert("RGB"))

"""Maps of a result: an estimate, a recovery, or a folder of textures from any program."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from svu_mi.capture import capture_folder
from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import mesh_key
from svu_mi.capture.mesh import make_mesh, read_ply
from svu_mi.core.io.files import read_json
from svu_mi.core.io.folder_exchange import restore
from svu_mi.core.io.provenance import text_in
from svu_mi.errors import CaptureError, OptionError
from svu_mi.geometry.texels import texels
from svu_mi.output.maps import COVERAGE, ENTROPY, read_deviations, read_map
from svu_mi.output.run_record import RECORD
from svu_mi.output.texture_files import MESH, find_textures, read_texture
from svu_mi.parameters import NAMES
from svu_mi.posterior.estimate import Estimate
from svu_mi.recovery.recovery_result import Recovery

Source = str | Path | Capture | Estimate | Recovery

LEAST = 1e-3  # lower bound of the weight of a resampled texel


@dataclass(kw_only=True)
class ResultMaps:
    """Maps (H, W, C) of a result by name, each with its own size, and their metadata."""

    name: str
    about: str
    maps: dict[str, np.ndarray]
    sd: Mapping[str, np.ndarray] = field(default_factory=dict)  # standard deviations, if known
    seen: np.ndarray | None = None  # (H, W) bool, texels in photographs
    mesh: Any | None = None
    key: str = ""  # digest of the mesh
    notes: Sequence[str] = ()


def read_result(source: Source, name: str) -> ResultMaps | None:
    """Return the maps of a result; None for a capture, which must be estimated first."""
    if isinstance(source, Capture):
        return None
    if isinstance(source, Estimate):
        return maps_of_estimate(source, name, "an estimate")
    if isinstance(source, Recovery):
        side = ResultMaps(name=name, about="", maps={})
        if source.estimate is not None:
            side = maps_of_estimate(source.estimate, name, "")
        side.about, side.seen = "recovered textures", source.image("coverage") > 0
        side.maps |= {key: np.array(tensor) for key, tensor in source.textures.items()}
        return side
    path = Path(source)
    restore(path)
    is_capture = path.suffix.lower() == ".xml" or (path / capture_folder.FILE).is_file()
    return None if is_capture else _maps_of_folder(path, name)


def maps_of_estimate(result: Estimate, name: str, about: str) -> ResultMaps:
    """Return posterior means, standard deviations and entropy of an estimate."""
    if result.observed is None:
        raise OptionError(f"{name} has no capture; compare the result of svu.estimate().")
    means, sd = ({parameter: np.atleast_3d(result.image(f"{parameter}_{kind}"))
                  for parameter in result.posterior.axes} for kind in ("mean", "sd"))  # fmt: skip
    mesh, entropy = result.observed.capture.mesh, np.atleast_3d(result.image("entropy"))
    return ResultMaps(
        name=name, about=about, maps=means | {"entropy": entropy}, sd=sd,
        seen=result.image("coverage") > 0, mesh=mesh, key=mesh_key(mesh),
    )  # fmt: skip


def _maps_of_folder(path: Path, name: str) -> ResultMaps:
    """Read a result of ``svu entropy`` or ``svu recover``, or any folder of textures."""
    if not path.is_dir():
        raise CaptureError(f"{path}: no such folder; give a capture, a result of svu, or textures.")
    textures = {key: read_texture(file, key) for key, file in find_textures(path).items()}
    entropy, coverage, file = read_map(path / ENTROPY), read_map(path / COVERAGE), path / MESH
    if not textures and entropy is None:
        raise CaptureError(
            f"{path}: contains neither a capture (capture.json), nor {ENTROPY}, nor textures "
            f"({', '.join(NAMES)} as EXR or PNG); give another folder."
        )
    record = read_json(path / RECORD) if (path / RECORD).is_file() else {}
    mesh = make_mesh("object", read_ply(file)) if file.is_file() else None
    about = "a result of svu recover" if record else "textures"
    maps = {key: image for key, (image, _) in textures.items()}
    return ResultMaps(
        name=name, about=about if textures else "a result of svu entropy",
        maps=maps | ({} if entropy is None else {"entropy": entropy[..., None]}),
        sd=read_deviations(path) if textures else {},
        seen=None if coverage is None else coverage > 0,
        mesh=mesh, key=mesh_key(mesh) if mesh else text_in(record, "inputs", "mesh"),
        notes=[note for _, note in textures.values() if note],
    )  # fmt: skip


def resampled(
    image: np.ndarray, size: tuple[int, int], shown: np.ndarray | None = None,
    mesh: Any | None = None,
) -> np.ndarray:  # fmt: skip
    """Resample a map (H, W, C) to ``size``, (width, height); NaN far from valid texels.

    Texels are valid if they are finite, True in ``shown`` (H, W), and on a chart of the mesh.
    """
    weight = np.isfinite(image).all(axis=2)
    if shown is not None and shown.shape == weight.shape:
        weight &= shown
    if weight.shape != size[::-1] and mesh is not None:
        weight &= texels(mesh, weight.shape[::-1]).inside()
    smaller = size[0] <= image.shape[1] and size[1] <= image.shape[0]
    kind = Image.Resampling.BOX if smaller else Image.Resampling.BILINEAR  # means of areas
    planes = np.concatenate([np.where(weight[..., None] > 0, image, 0), weight[..., None]], axis=-1)
    *sums, total = (np.asarray(Image.fromarray(np.float32(planes[..., k])).resize(size, kind))
                    for k in range(planes.shape[2]))  # fmt: skip
    near = np.where(total > LEAST, total, np.nan)
    return np.stack([plane / near for plane in sums], axis=-1)

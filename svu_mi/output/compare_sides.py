"""One side of a comparison: what an estimate, a result in a folder, or anybody's textures say."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture import Capture, load_capture
from svu_mi.capture import folder as capture_folder
from svu_mi.capture.fingerprint import mesh_key
from svu_mi.capture.loading import Preflight
from svu_mi.capture.mesh import arrays, make, read_ply
from svu_mi.capture.window import Detail
from svu_mi.errors import CaptureError, OptionError
from svu_mi.exr import read_exr
from svu_mi.files import read_json
from svu_mi.illumination.finding import illuminated
from svu_mi.output.manifest import RECORD
from svu_mi.output.maps import COVERAGE, ENTROPY, UNCERTAINTY
from svu_mi.output.scene_xml import MESH
from svu_mi.output.textures import find_textures, read_texture
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.pipeline import Estimate, estimate
from svu_mi.progress import Progress
from svu_mi.recovery.recover import Recovery
from svu_mi.results.reading import text_in
from svu_mi.results.settling import settle
from svu_mi.surface import texels

Source = str | Path | Capture | Estimate | Recovery


@dataclass(frozen=True, kw_only=True)
class Side:
    """Maps of one side, each of its own size.

    Attributes:
        name: what it is called, such as the path of a folder.
        about: what it is.
        values: by parameter (H, W, C); NaN where there is none.
        sd: standard deviations of these, as far as they are known.
        entropy: (H, W), None if it is not known.
        seen: (H, W) bool, what any photograph shows; None if that is not known.
        mesh: the ``mi.Mesh`` that the maps belong to, with its UVs; None if it is not known.
        key: digest of that mesh, empty if it is not known.
        sensors: from where it was photographed; empty if that is not known.
        notes: sentences on how it was read.
    """

    name: str
    about: str
    values: Mapping[str, np.ndarray] = field(default_factory=dict)
    sd: Mapping[str, np.ndarray] = field(default_factory=dict)
    entropy: np.ndarray | None = None
    seen: np.ndarray | None = None
    mesh: Any | None = None
    key: str = ""
    sensors: tuple[Any, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def size(self) -> tuple[int, int]:
        """(W, H) of its largest map."""
        maps = [*self.values.values(), *([] if self.entropy is None else [self.entropy])]
        height, width = max((image.shape[:2] for image in maps), key=lambda shape: shape[0])
        return width, height


def is_capture(source: Source) -> bool:
    """Return whether a side must be estimated: a capture, its folder, or a scene."""
    if isinstance(source, str | Path):
        path = Path(source)
        return path.suffix.lower() == ".xml" or (path / capture_folder.FILE).is_file()
    return isinstance(source, Capture)


@dataclass(frozen=True, kw_only=True)
class Work:
    """How captures are read and estimated.

    Attributes:
        size: (W, H) of their maps.
        trust: as of ``load_capture``.
        progress: shows what is going on.
        preflight: by the path of a capture and ``size``, what ``load_capture`` takes.
        memory: bytes that photographs may take, likewise.
    """

    size: tuple[int, int]
    trust: bool = False
    progress: Progress = field(default_factory=Progress)
    preflight: Callable[[str, tuple[int, int]], Preflight] | None = None
    memory: float | None = None


def estimated(source: Source, name: str, preset: str, work: Work) -> Side:
    """Estimate a capture, for which ``is_capture`` is true; one on disk needs no light.

    Args:
        source: the ``Capture``, or where it lies.
        name: what it is called.
        preset: of the method ``angular``.
        work: how.

    Raises:
        SvuError: as ``load_capture``, ``texels`` and ``estimate``.
    """
    if isinstance(source, str | Path):
        preflight = None if work.preflight is None else work.preflight(str(source), work.size)
        with work.progress.stage("Loading the capture"):
            source = load_capture(
                source, trust=work.trust, light="optional", preflight=preflight,
                detail=Detail(texels=work.size), memory=work.memory,
            )  # fmt: skip
        source = illuminated(source, progress=work.progress)
    assert isinstance(source, Capture)
    laid_out = texels(source.mesh, work.size)
    found = estimate(source, laid_out, preset=preset, progress=work.progress)
    return of_estimate(found, name, f"a capture, estimated with the preset {preset}")


def of_estimate(found: Estimate, name: str, about: str = "an estimate") -> Side:
    """Return what an estimate says: means and standard deviations of its posterior.

    Raises:
        OptionError: it does not know its capture, and so the mesh.
    """
    if found.observed is None:
        raise OptionError(f"{name} does not know its capture; compare what estimate() returns.")

    def laid_out(values: Any) -> np.ndarray:
        flat = np.array(values, np.float32).reshape(found.texels.count, -1)
        return found.texels.to_image(flat, np.nan)

    posterior, capture = found.posterior, found.observed.capture
    return Side(
        name=name, about=about,
        values={parameter: laid_out(posterior.mean(parameter)) for parameter in posterior.axes},
        sd={parameter: laid_out(posterior.sd(parameter)) for parameter in posterior.axes},
        entropy=found.image("entropy"), seen=found.image("coverage") > 0,
        mesh=make("object", arrays(capture.mesh)), key=mesh_key(capture.mesh),
        sensors=capture.used_sensors,
    )  # fmt: skip


def of_recovery(found: Recovery, name: str) -> Side:
    """Return recovered textures, with what is known of them."""
    known, covered = found.estimate, found.image("coverage") > 0
    textures = {key: np.array(tensor) for key, tensor in found.textures.items()}
    if known is None:
        return Side(
            name=name, about="recovered textures", values=textures, seen=covered
        )
    side = of_estimate(known, name)
    return Side(
        name=name, about="recovered textures", values=textures, sd=side.sd, entropy=side.entropy,
        seen=covered, mesh=side.mesh, key=side.key, sensors=side.sensors,
    )  # fmt: skip


def of_folder(path: Path, name: str) -> Side:
    """Read a result of ``svu entropy`` or ``svu recover``, or any folder of textures.

    Raises:
        CaptureError: it is none of these, or a file is damaged or does not fit.
        MeshError: the mesh of a result cannot be read.
    """
    if not path.is_dir():
        raise CaptureError(f"{path}: no such folder; give a capture, a result of svu, or textures.")
    settle(path)
    found = {key: read_texture(file, key) for key, file in find_textures(path).items()}
    maps = {file: _map(path / file) for file in (ENTROPY, COVERAGE) if (path / file).is_file()}
    if not found and ENTROPY not in maps:
        raise CaptureError(
            f"{path}: holds neither a capture (capture.json), nor {ENTROPY}, nor textures "
            f"({', '.join(NAMES)} as EXR or PNG); give a folder that does."
        )
    mesh = None
    if (path / MESH).is_file():
        mesh = make("object", read_ply(path / MESH))
    record = read_json(path / RECORD) if (path / RECORD).is_file() else {}
    notes = tuple(note for _, note in found.values() if note)
    return Side(
        name=name, about=_about(record, bool(found)),
        values={key: image for key, (image, _) in found.items()},
        sd=_deviations(path / UNCERTAINTY) if found else {},
        entropy=maps.get(ENTROPY), seen=maps[COVERAGE] > 0 if COVERAGE in maps else None,
        mesh=mesh, key=mesh_key(mesh) if mesh is not None else text_in(record, "inputs", "mesh"),
        notes=notes,
    )  # fmt: skip


def _about(record: Any, textured: bool) -> str:
    if not textured:
        name = text_in(record, "settings", "preset", "name")
        return "a result of svu entropy" + (f", preset {name}" if name else "")
    return "a result of svu recover" if record else "textures"


def _map(path: Path) -> np.ndarray:
    channels = read_exr(path)
    if "Y" not in channels:
        raise CaptureError(f"{path}: expected the channel Y, found {', '.join(channels)}.")
    return channels["Y"]


def _deviations(path: Path) -> dict[str, np.ndarray]:
    """Return standard deviations (H, W, C) as ``write_uncertainty`` has written them."""
    channels = read_exr(path) if path.is_file() else {}
    found = {}
    for name in CHANNELS:
        planes = [channels[f"{name}.sd{c}"] for c in ("", ".R", ".G", ".B")
                  if f"{name}.sd{c}" in channels]  # fmt: skip
        if planes:
            found[name] = np.stack(planes, axis=-1)
    return found

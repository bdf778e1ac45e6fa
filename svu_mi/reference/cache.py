"""References on disk: one file per key, the key made of everything that matters."""

from __future__ import annotations

import hashlib
import logging
import warnings
import zipfile
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

import svu_mi
from svu_mi.capture import Capture
from svu_mi.capture.mesh import arrays
from svu_mi.capture.poses import describe
from svu_mi.capture.repaint import is_same, is_two_sided
from svu_mi.errors import SvuError, SvuWarning
from svu_mi.files import prepare_folder, replacing
from svu_mi.reference.options import Options
from svu_mi.reference.record import Reference, Traced
from svu_mi.surface import Texels

log = logging.getLogger(__name__)

FORMAT = 3  # raised whenever the same input would give another result, or another file


def locate(
    folder: str | Path,
    capture: Capture,
    texels: Texels,
    subset: int | np.ndarray,
    options: Options,
) -> Path:
    """Return the file of one reference; its folder exists afterwards.

    Raises:
        OutputError: the folder cannot be made or written.
    """
    key = _Key()
    key.add(FORMAT, svu_mi.__version__, mi.__version__, mi.variant(), options, subset)
    _add_geometry(key, capture, texels)
    _add_light(key, capture.scene)
    for view in range(capture.count):
        if capture.used[view]:
            key.add(describe(capture.sensors[view]), capture.images[view], capture.masks[view])
    return prepare_folder(folder) / f"reference-{key.digest()}.npz"


def load(path: Path, options: Options) -> Reference | None:
    """Read a reference back; None, with a warning, when the file is damaged."""
    if not path.exists():
        return None
    try:
        # Opened here: NumPy leaves its own file open when the archive is broken.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            return _unpack(dict(stored), options)
    except (OSError, EOFError, KeyError, ValueError, TypeError, zipfile.BadZipFile, SvuError) as e:
        warnings.warn(
            f"{path}: the cached reference cannot be read ({e}); it is traced again.",
            SvuWarning,
            stacklevel=3,
        )
        return None


def store(path: Path, reference: Reference) -> None:
    """Write a reference.

    Raises:
        OutputError: it cannot be written.
    """
    traced = reference.traced
    weight = {} if traced.weight is None else {"weight": traced.weight}
    with replacing(path) as temporary:
        np.savez(
            temporary,
            subset=reference.subset,
            tables=traced.tables,
            **weight,  # type: ignore[arg-type]
            unit=reference.unit,
            brightness=reference.brightness,
            coverage=reference.coverage,
            scalars=np.array([reference.scale, reference.seconds]),
            counts=np.array([reference.rays, reference.dropped]),
        )
    log.debug("%s: reference stored", path)


def _unpack(stored: dict[str, np.ndarray], options: Options) -> Reference:
    found = Traced(stored["tables"], stored.get("weight"), stored["coverage"])
    unit = float(stored["unit"])
    whole, first, second = found.posteriors(options, unit)
    scale, seconds = stored["scalars"].tolist()
    rays, dropped = stored["counts"].tolist()
    return Reference(
        subset=stored["subset"],
        posterior=whole,
        halves=(first, second),
        traced=found,
        unit=unit,
        brightness=stored["brightness"],
        coverage=stored["coverage"],
        scale=scale,
        seconds=seconds,
        cached=True,
        rays=rays,
        dropped=dropped,
        spp=options.spp,
        max_depth=options.max_depth,
        method=options.method,
    )


def _add_geometry(key: _Key, capture: Capture, texels: Texels) -> None:
    mesh = arrays(capture.shape)
    key.add(mesh.positions, mesh.faces, mesh.normals, is_two_sided(capture.shape.bsdf()))
    for values in (texels.position, texels.normal, texels.geometric_normal):
        key.add(values.numpy())
    for shape in capture.scene.shapes():
        if not is_same(shape, capture.shape):
            key.add(shape.id(), shape.class_name())
            key.add_parameters(shape)


def _add_light(key: _Key, scene: Any) -> None:
    for emitter in scene.emitters():
        if emitter.is_environment():
            key.add(emitter.class_name(), np.array(emitter.world_transform().matrix))
            key.add_parameters(emitter)


class _Key:
    """SHA-256 over a sequence of values; arrays with their type and shape."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def add(self, *values: Any) -> None:
        """Add arrays, and anything else by its ``repr``."""
        for value in values:
            if isinstance(value, np.ndarray):
                self._text(f"{value.dtype}{value.shape}")
                self._hash.update(np.ascontiguousarray(value).data)
            else:
                self._text(repr(value))

    def add_parameters(self, node: Any) -> None:
        """Add all that ``mi.traverse`` finds in a node, nested nodes included."""
        for name, value in mi.traverse(node):
            # Nodes without an id are named by their address.
            self._text(name.rsplit(".", 1)[-1])
            self.add(np.array(getattr(value, "matrix", value)))

    def digest(self) -> str:
        """Return the key as a hexadecimal string."""
        return self._hash.hexdigest()

    def _text(self, text: str) -> None:
        self._hash.update(text.encode() + b"\0")

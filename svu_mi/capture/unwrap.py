"""UV unwrapping of meshes by xatlas."""

import contextlib
import hashlib
import importlib.metadata
import logging
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture import unwrap_process
from svu_mi.capture.mesh import MeshArrays, arrays, make_mesh, read_ply, write_ply
from svu_mi.core.io.files import clear_temporaries
from svu_mi.errors import MeshError

log = logging.getLogger(__name__)

UNWRAPPED = "unwrapped.ply"
KEY = "svu_mi unwrapped "  # prefix of the digest in a comment of the file's header
HEADER = 4096  # bytes; the header of the PLY file must be shorter
HUGE = 200_000  # faces, from which simplification is proposed
LARGE = 20_000  # faces, from which a mesh is unwrapped in pieces by another process
PERIOD = 15.0  # seconds between two lines about the progress
PACE = 10_000  # faces per second, about


def unwrap(mesh: Any, label: str = "") -> Any:
    """Return a copy of a mesh with new UVs that do not overlap.

    The atlas depends on the version of xatlas; ``unwrap_cached`` saves it for later runs.
    """
    source, label = arrays(mesh), label or f"Shape '{mesh.id()}'"
    if len(source.faces) == 0:
        raise MeshError(f"{label} has no faces, so it cannot be unwrapped.")
    low, high = source.positions.min(axis=0), source.positions.max(axis=0)
    unit = (source.positions - low) / max(float((high - low).max()), 1e-300)
    is_large = len(source.faces) > LARGE
    if is_large:
        log.warning(
            "%s: UVs of %d faces are computed, which takes about %.0f s. Ctrl-C stops it%s.",
            label, len(source.faces), len(source.faces) / PACE,
            "; svu import --faces 100000 simplifies it first" if len(source.faces) > HUGE else "",
        )  # fmt: skip
    layout = _layout_of_large if is_large else unwrap_process.layout
    vmap, faces, uvs = layout(unit, source.faces)
    if len(faces) != len(source.faces) or not np.isfinite(uvs).all():
        raise MeshError(
            f"{label} cannot be unwrapped automatically; give it UVs in a modelling tool and load "
            "it again."
        )
    normals = None if source.normals is None else source.normals[vmap]
    return make_mesh(mesh.id(), MeshArrays(source.positions[vmap], faces, normals, uvs))


def _layout_of_large(
    points: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Run ``unwrap_process`` and print its progress; Ctrl-C ends it, too."""
    with tempfile.TemporaryDirectory(prefix="svu-unwrap-") as folder:
        given, made = Path(folder, "given.npz"), Path(folder, "made.npz")
        np.savez(given, points=points, faces=faces)
        words = [sys.executable, "-m", unwrap_process.__name__, str(given), str(made)]
        start = time.monotonic()
        with subprocess.Popen(words) as process:
            try:
                while process.poll() is None:
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(PERIOD)
                        break
                    log.warning("Computing UVs: %.0f s.", time.monotonic() - start)
            finally:
                process.kill()
        if not made.is_file():  # killed, or out of memory
            return np.zeros(0, np.int64), np.zeros((0, 3), np.int64), np.zeros((0, 2))
        with np.load(made) as result:
            return result["vmap"], result["faces"], result["uvs"]


def unwrap_cached(mesh: Any, folder: Path | None) -> Any:
    """Unwrap a mesh, or reuse the UVs that an earlier run saved in a folder.

    A saved file that is damaged, modified or from another mesh is replaced, with a logged warning.
    """
    path, source = None if folder is None else folder / UNWRAPPED, arrays(mesh)
    if path is not None and path.exists():
        try:
            return make_mesh(mesh.id(), _saved(path, source))
        except MeshError as error:
            log.warning("%s; the mesh is unwrapped again.", error)
    made = unwrap(mesh)
    if path is not None and os.access(path.parent, os.W_OK):
        clear_temporaries(path.parent)
        flat = arrays(made)
        version = importlib.metadata.version("xatlas")
        write_ply(path, mesh.id(), flat, f"{KEY}{_key(source, flat)} xatlas {version}")
    return made


def _saved(path: Path, source: MeshArrays) -> MeshArrays:
    """Combine the UVs of a saved file with positions and normals of a mesh."""
    if not path.is_file():  # opening a pipe would block
        raise MeshError(f"{path}: is not a file")
    try:
        with path.open("rb") as stream:
            header = stream.read(HEADER).partition(b"end_header")[0].decode("ascii", "replace")
    except OSError as error:
        raise MeshError(f"{path}: cannot be opened ({error.strerror})") from error
    key, saved = re.search(rf"^comment {KEY}([0-9a-f]+)", header, re.MULTILINE), read_ply(path)
    if saved.uvs is None or not np.isfinite(saved.uvs).all():
        raise MeshError(f"{path}: has no finite UVs")
    is_own = key is not None and key[1] == _key(source, saved)
    if not is_own or saved.faces.shape != source.faces.shape:
        raise MeshError(f"{path}: belongs to another mesh, or was changed")
    # Unwrapping duplicates vertices but keeps the order of faces, which maps them back.
    vertex = np.zeros(len(saved.positions), np.int64)
    vertex[saved.faces] = source.faces
    if not np.array_equal(vertex[saved.faces], source.faces):
        raise MeshError(f"{path}: its UVs would merge vertices of the mesh")
    normals = None if source.normals is None else source.normals[vertex]
    return MeshArrays(source.positions[vertex], saved.faces, normals, saved.uvs)


def _key(source: MeshArrays, flat: MeshArrays) -> str:
    """Return a digest of a mesh and its UVs in single precision.

    The digest does not depend on the version of xatlas, so saved UVs remain valid.
    """
    key = hashlib.blake2b(digest_size=16)
    for rows in (source.positions, source.normals, flat.uvs):
        key.update(b"-" if rows is None else np.ascontiguousarray(rows, "<f4").tobytes())
    for faces in (source.faces, flat.faces):
        key.update(np.ascontiguousarray(faces, "<i8").tobytes())
    return key.hexdigest()

"""Files of a scene, above all its meshes, checked before Mitsuba builds on them.

A wrong index may end the process (see ``missing_corner``). So each file is read once more, by
Mitsuba's own reader, as a mesh without vertex normals: 1 million triangles take 0.03 to 0.05 s,
where making the scene takes more than 1 s.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi

from svu_mi.capture.mesh import READING, missing_corner, refusal
from svu_mi.capture.nesting import LONGEST, require_file
from svu_mi.errors import SceneError, excerpt

READERS = ("ply", "serialized", "obj")  # shapes with indices that come from a file
KEYS = ("filename", "shape_index")  # their properties that choose what is read


def check_files(state: Any, label: str) -> None:
    """Check all files that the nodes of a scene refer to, and the meshes in them.

    Args:
        state: a ``mi.parser.ParserState``; files are found as ``mi.file_resolver()`` does.
        label: the scene's file, for messages.

    Raises:
        SceneError: one is a folder or a pipe, or a mesh that cannot be read, or a face has a
            vertex that does not exist.
    """
    meshes: dict[tuple[Any, ...], dict[str, Any]] = {}
    for node in state.nodes:
        kind, props = node.props.plugin_name(), node.props
        if not isinstance(props.get("filename"), str):
            continue
        path = _path(props["filename"])
        require_file(path, label)
        if kind in READERS:
            found = {"type": kind, **{key: props[key] for key in KEYS if key in props}}
            meshes[tuple(found.values())] = found
    for found in meshes.values():
        _check_mesh(found, f"{label}: {excerpt(_path(found['filename']), LONGEST)}")


def _check_mesh(found: dict[str, Any], label: str) -> None:
    try:
        mesh: Any = mi.load_dict({**found, "face_normals": True})
    except READING as error:
        raise SceneError(
            f"{label}: cannot be read: {refusal(error)}; export the mesh again."
        ) from error
    if problem := missing_corner(mesh):
        raise SceneError(f"{label}: {problem}; export the mesh again.")


def _path(name: str) -> Path:
    return Path(str(mi.file_resolver().resolve(name)))

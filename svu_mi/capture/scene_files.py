"""Checks of a scene's XML files and meshes before Mitsuba reads them.

Deeply nested XML crashes Mitsuba's parser, and pipes block it. An invalid vertex index may abort
the process (see ``missing_corner``), so each mesh is first read without vertex normals. One million
triangles take 0.03 to 0.05 s.
"""

import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Mapping
from os.path import exists, isfile  # unlike Path's, they raise nothing for long names
from pathlib import Path
from typing import Any
from xml.parsers import expat

import mitsuba as mi

from svu_mi.capture.mesh import READING, mesh_error, missing_corner
from svu_mi.core.io.files import may_hold
from svu_mi.core.validation import require_views
from svu_mi.errors import SceneError, excerpt

DEEPEST = 500  # nested elements; Mitsuba's parser is recursive, and 10 000 overflow its stack
LARGEST_XML = 1 << 26  # bytes of a file
LONGEST_VALUE = 1 << 16  # characters of an attribute after substitution of $parameters
FILLED_PER_FILE = 1 << 24  # characters of all these attributes of a file
MOST_PARAMETERS = 1000
LONGEST = 240  # characters of a path in messages
READERS = ("ply", "serialized", "obj")  # shape plugins that read meshes from files
KEYS = ("filename", "shape_index")  # properties that select the mesh
UNNAMED = "_arg_"  # start of the names that Mitsuba makes up
CORNERS = 12  # bytes of a vertex or triangle of a serialized mesh, at least
HEADER = 2**12  # bytes before its numbers: flags and a name


def check_xml(path: Path, defines: Mapping[str, str]) -> None:
    """Check a scene's XML files; raise if Mitsuba might crash or block."""
    parameters = dict(defines)
    waiting, seen, sensors = [path], set(), 0
    while waiting:
        file = waiting.pop()
        if file in seen or not exists(file):  # Mitsuba reports missing files
            continue
        require_file(file, path)
        seen.add(file)
        label = str(path) if file == path else f"{path}: {excerpt(file, LONGEST)}"
        reader = _Reader(file, label, parameters)
        sensors += reader.sensors
        for name in reader.others:
            require_file(_resolve(name, file), path)
        waiting += [_resolve(name, file) for name in reader.includes]
    require_views(sensors, f"{path}: sensors", SceneError)


def require_file(file: Path, label: str | Path) -> None:
    """Raise for folders and pipes; Mitsuba reports missing files."""
    if exists(file) and not isfile(file):  # reading a pipe would block
        raise SceneError(
            f"{label}: refers to {excerpt(file, LONGEST)}, which is not a file; correct the name."
        )


def _resolve(name: str, file: Path) -> Path:
    """Return the path of a file: next to ``file``, or in the search path."""
    beside = file.parent / name
    return beside if exists(beside) else Path(str(mi.file_resolver().resolve(name)))


class _Reader:
    """References and sensors of one XML file.

    Attributes:
        includes: Names of included XML files.
        others: Names of other referenced files.
        sensors: Number of sensors.
    """

    def __init__(self, path: Path, label: str, parameters: dict[str, str]) -> None:
        """Parse a file, and add its ``<default>`` values to ``parameters``."""
        self.includes: list[str] = []
        self.others: list[str] = []
        self.sensors = 0
        self._label, self._parameters, self._depth, self._letters = label, parameters, 0, 0
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler, self._parser.EndElementHandler = self._start, self._end
        try:
            if path.stat().st_size > LARGEST_XML:
                raise self._error(
                    f"the file has more than {LARGEST_XML >> 20} MiB", "split it by <include>"
                )
            # Parsed at once: for chunks, expat would rescan a long attribute after each of them.
            self._parser.Parse(path.read_bytes(), True)
        except expat.ExpatError as error:
            raise SceneError(
                f"{label}: not well-formed XML ({error}); correct it there."
            ) from error
        except OSError as error:
            raise SceneError(f"{label}: cannot be read ({error.strerror}).") from error

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth > DEEPEST:
            problem = f"elements are nested more than {DEEPEST} deep"
            raise self._error(problem, "check for unclosed ones")
        self.sensors += tag == "sensor"
        values = {key: self._filled(value) for key, value in attributes.items()}
        if tag == "default":
            self._parameters.setdefault(values.get("name", ""), values.get("value", ""))
            if len(self._parameters) > MOST_PARAMETERS:
                problem = f"more than {MOST_PARAMETERS} parameters"
                raise self._error(problem, "remove some")
        elif "filename" in values:
            names = self.includes if tag == "include" else self.others
            names.append(values["filename"])

    def _end(self, tag: str) -> None:
        del tag
        self._depth -= 1

    def _filled(self, text: str) -> str:
        """Substitute ``$parameters``, longest names first as in Mitsuba."""
        if "$" not in text:
            return text
        for name in sorted(filter(None, self._parameters), key=len, reverse=True):
            value = self._parameters[name]
            more = len(value) - len(name) - 1
            if len(text) + text.count(f"${name}") * more > LONGEST_VALUE:
                problem = f"with its $parameters, a value has over {LONGEST_VALUE} characters"
                raise self._error(problem, "shorten it")
            text = text.replace(f"${name}", value)
        self._letters += len(text)
        if self._letters > FILLED_PER_FILE:
            problem = f"with their $parameters, values have over {FILLED_PER_FILE} characters"
            raise self._error(problem, "shorten them")
        return text

    def _error(self, problem: str, remedy: str) -> SceneError:
        """Return an error with the file and the current line."""
        line = self._parser.CurrentLineNumber
        return SceneError(f"{self._label}: {problem} at line {line}; {remedy}.")


def check_files(state: Any, label: str) -> None:
    """Check all files and meshes that a parsed scene refers to."""
    meshes: dict[tuple[Any, ...], dict[str, Any]] = {}
    for node in state.nodes:
        kind, props = node.props.plugin_name(), node.props
        if not isinstance(props.get("filename"), str):
            continue
        path = _path(props["filename"])
        require_file(path, label)
        if kind in READERS:
            settings = {"type": kind, **{key: props[key] for key in KEYS if key in props}}
            meshes[tuple(settings.values())] = settings
    for settings in meshes.values():
        _check_mesh(settings, f"{label}: {excerpt(_path(settings['filename']), LONGEST)}")


def name_objects(state: Any) -> None:
    """Give ids to objects of the scene without one: their ``name``, as ``mi.load_dict`` does.

    Other shapes become ``mesh.ply``, ``mesh.ply-0`` of several, or ``sphere-2``, counted from 0 in
    the order of ``mi.Scene.shapes()``. ``mi.parser.write_file`` writes keys as names.
    """
    children = [(name, node) for name, node in state.root.props.items() if hasattr(node, "index")]
    named = [(name, state.nodes[node.index()]) for name, node in children]
    taken = {node.props.id() for node in state.nodes}
    for name, node in named:
        if not (node.props.id() or name in taken or name.startswith(UNNAMED)):
            node.props.set_id(name)
            taken.add(name)
    shapes = [node.props for _, node in named if node.type == mi.ObjectType.Shape]
    shapes = [props for props in shapes if props.plugin_name() != "shapegroup"]
    files = [Path(str(props.get("filename", ""))).name for props in shapes]
    counts = Counter(files)
    for number, (props, file) in enumerate(zip(shapes, files, strict=True)):
        if not props.id():
            single = file and counts[file] == 1
            name = file if single else f"{file or props.plugin_name()}-{number}"
            while name in taken:
                name += "-"
            props.set_id(name)
            taken.add(name)


def _check_mesh(settings: dict[str, Any], label: str) -> None:
    try:
        if settings["type"] == "serialized":
            _check_serialized(_path(settings["filename"]), int(settings.get("shape_index", 0)))
        if settings["type"] == "ply":
            _check_ply(_path(settings["filename"]))
        mesh: Any = mi.load_dict({**settings, "face_normals": True})
    except (OSError, ValueError, struct.error, zlib.error, *READING) as error:
        reason = getattr(error, "strerror", None) or mesh_error(error)
        raise SceneError(f"{label}: cannot be read: {reason}; export the mesh again.") from error
    if problem := missing_corner(mesh):
        raise SceneError(f"{label}: {problem}; export the mesh again.")


def _check_ply(path: Path) -> None:
    """Raise ValueError if a header counts more elements than the file has bytes."""
    with path.open("rb") as file:
        head, _, _ = file.read(HEADER).partition(b"end_header")
    for name, count in re.findall(rb"^element\s+(\S+)\s+(\d+)", head, re.MULTILINE):
        if int(count) > path.stat().st_size:
            raise ValueError(
                f"the file cannot contain {int(count)} elements {excerpt(name.decode('latin-1'))}"
            )


def _check_serialized(path: Path, index: int) -> None:
    """Raise ValueError if a mesh declares more than its file can contain; Mitsuba allocates it.

    A file is a sequence of compressed meshes, their offsets, and their number.
    """
    with path.open("rb") as file:
        version = struct.unpack("<HH", file.read(4))[1]
        if index:
            word = 8 if version > 3 else 4
            file.seek(-4, os.SEEK_END)
            (count,) = struct.unpack("<I", file.read(4))
            file.seek(-4 - word * (count - index), os.SEEK_END)
            file.seek(int.from_bytes(file.read(word), "little") + 4)
        head = zlib.decompressobj().decompress(file.read(2 * HEADER), HEADER)
    name = head.index(b"\0", 4) + 1 if version > 3 else 4
    vertices, triangles = struct.unpack_from("<QQ", head, name)
    if not may_hold(path, CORNERS * (vertices + triangles)):
        raise ValueError(f"the file cannot contain {vertices} vertices and {triangles} triangles")


def _path(name: str) -> Path:
    return Path(str(mi.file_resolver().resolve(name)))

"""Protection against plugin libraries in the folders of scenes.

For ``type="name"``, Mitsuba searches ``plugins/name.so`` in the folder of the scene, in the folders
of ``<path>`` tags, and in the working directory. If it finds none, it uses its own plugins and
those registered in Python. A downloaded scene could therefore run code. Parsing loads no
library, so parsed scenes are checked before their objects are made.
"""

import contextlib
import functools
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi

from svu_mi.errors import SceneError, SvuEnvironmentError, excerpt

FOLDER = "plugins"
LONGEST = 300  # characters of a path in messages
SUFFIXES = (".so", ".dylib", ".dll")  # Linux, macOS, Windows


def require_own_plugins(trust: bool = False) -> None:
    """Raise if Mitsuba could load a library of the working directory as a plugin.

    Called before a scene is loaded. ``pin_own_plugins`` is not sufficient, because Mitsuba searches
    these folders again for each plugin registered in Python, such as ``prb``.
    """
    pin_own_plugins()
    if not trust:
        _refuse_libraries([Path(), *_searched_folders()])


@functools.cache
def pin_own_plugins() -> frozenset[str]:
    """Load all plugins of Mitsuba's own folder, and return their names.

    Mitsuba never searches a loaded plugin again, so no other folder can replace it. The first call
    takes 0.03 to 0.08 s.
    """
    folder = _own_folder()
    files = map(Path, _names(folder / FOLDER))
    names = frozenset(file.stem for file in files if file.suffix in SUFFIXES)
    manager = mi.PluginManager.instance()
    with search_folder_first(str(folder)):
        for name in sorted(names):
            with contextlib.suppress(RuntimeError):  # unsupported on this system
                manager.plugin_type(name)
    return names


def own_plugin(description: dict[str, Any]) -> Any:
    """Make a plugin registered in Python; raise if a library has its name."""
    _refuse_files_of(description["type"])
    return mi.load_dict(description)


def refuse_foreign(state: Any, label: str) -> None:
    """Raise if a scene (parser state) could load a foreign library."""
    _refuse_libraries([*(Path(str(file)).parent for file in state.files), *_searched_folders()])
    for name in {node.props.plugin_name() for node in state.nodes} - pin_own_plugins():
        if name in (".", "..") or "/" in name or "\\" in name:
            raise SceneError(
                f"{label}: {excerpt(repr(name))} is a path, not a plugin type; use the name of a "
                "plugin of Mitsuba or svu_mi."
            )
        _refuse_files_of(name)


def _refuse_libraries(folders: Iterable[Path]) -> None:
    for place in dict.fromkeys(folder / FOLDER for folder in folders):
        if Path(os.path.realpath(place)) == _own_folder() / FOLDER:
            continue  # some hundred files
        for path in map(place.joinpath, _names(place)):
            if path.suffix.lower() in SUFFIXES and not _is_own(path):
                raise _refused(path)


def _searched_folders() -> list[Path]:
    """Return Mitsuba's search path of files and plugins, in order."""
    return [Path(str(folder)) for folder in mi.file_resolver()]


@contextlib.contextmanager
def search_folder_first(folder: str) -> Iterator[None]:
    """Put a folder first in Mitsuba's search path, within a ``with`` block.

    After the block, the folders of ``<path>`` tags are not searched, either.
    """
    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    resolver.prepend(folder)
    mi.set_file_resolver(resolver)
    try:
        yield
    finally:
        mi.set_file_resolver(before)


def _refuse_files_of(name: str) -> None:
    for file in _libraries(name):
        library = Path(str(mi.file_resolver().resolve(file)))
        if os.path.exists(library) and not _is_own(library):
            raise _refused(library)


def _refused(path: Path) -> SceneError:
    words = (
        f"{excerpt(path, LONGEST)}: Mitsuba would run this library as a plugin; remove it, run "
        "from another folder if it is in the working directory, or {} if you trust its author."
    )
    return SceneError(
        words.replace("{}", "pass trust=True"), shell=words.replace("{}", "give --trust")
    )


@functools.cache
def _own_folder() -> Path:
    """Return the folder of Mitsuba's ``plugins``: its package or build tree."""
    for folder in Path(mi.__file__).resolve().parents[:3]:
        if any((folder / FOLDER / f"principled{suffix}").is_file() for suffix in SUFFIXES):
            return folder
    raise SvuEnvironmentError(
        f"{mi.__file__}: this Mitsuba has no plugins folder; install it again."
    )


def _is_own(path: Path) -> bool:
    return Path(os.path.realpath(path)).parent == _own_folder() / FOLDER


def _libraries(name: str) -> list[str]:
    """Return the names of library files that Mitsuba searches for a plugin ``name``."""
    path = mi.filesystem.path
    return [str((path(FOLDER) / path(name)).replace_extension(path(end))) for end in SUFFIXES]


def _names(folder: Path) -> list[str]:
    """Return the sorted names in a folder; empty if it cannot be listed."""
    try:
        return sorted(os.listdir(folder))
    except OSError:
        return []

"""Restrict Mitsuba to its own plugin libraries: none beside a scene is loaded.

For ``type="name"`` Mitsuba takes ``plugins/name.so`` from the folder of the scene, from those of
its ``<path>`` tags, or from the working directory, before its own of that name, and before a
plugin that is registered in Python. So a scene, or a folder to work in, could bring code that
runs. Parsing alone loads nothing: all is judged between parsing and making the objects, by what
Mitsuba itself has parsed.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi

from svu_mi.errors import SceneError, SvuEnvironmentError, excerpt

FOLDER = "plugins"
LONGEST = 300  # letters of a path, in messages
SUFFIXES = (".so", ".dylib", ".dll")  # Linux, macOS, Windows


def require_own_plugins(trust: bool = False) -> None:
    """Make sure that no library of the working directory is loaded as a plugin.

    Called where a command or a function that loads a scene starts. Plugins that are registered
    in Python, such as Mitsuba's ``prb`` and those of svu_mi, are looked for in these folders
    every time, so ``pin_own_plugins`` does not do for them.
    """
    pin_own_plugins()
    if not trust:
        _refuse_libraries([Path(), *_searched_folders()])


@functools.cache
def pin_own_plugins() -> frozenset[str]:
    """Load Mitsuba's own plugins, from its own folder, and return their names.

    Takes 0.03 to 0.08 s, once. Mitsuba never looks again for a plugin that it has: from here on
    none of these names is taken from elsewhere, whatever the scene and the working directory.
    """
    folder = _own_folder()
    files = map(Path, _names(folder / FOLDER))
    names = frozenset(file.stem for file in files if file.suffix in SUFFIXES)
    manager = mi.PluginManager.instance()
    with search_folder_first(str(folder)):
        for name in sorted(names):
            with contextlib.suppress(RuntimeError):  # one that cannot run here
                manager.plugin_type(name)
    return names


def own_plugin(description: dict[str, Any]) -> Any:
    """Make a plugin that is registered in Python, not what a folder has under its name."""
    _refuse_files_of(description["type"])
    return mi.load_dict(description)


def refuse_foreign(state: Any, label: str) -> None:
    """Refuse a scene that would load a library, or whose folders have one."""
    _refuse_libraries([*(Path(str(file)).parent for file in state.files), *_searched_folders()])
    for name in {node.props.plugin_name() for node in state.nodes} - pin_own_plugins():
        if name in (".", "..") or "/" in name or "\\" in name:
            raise SceneError(
                f"{label}: {excerpt(repr(name))} is a path, not a plugin type; use the name of a "
                "plugin of Mitsuba or svu_mi."
            )
        _refuse_files_of(name)


def _refuse_libraries(folders: Iterable[Path]) -> None:
    for folder in dict.fromkeys(folders):
        for name in _names(folder / FOLDER):
            path = folder / FOLDER / name
            if path.suffix.lower() in SUFFIXES and not _is_own(path):
                raise _refused(path)


def _searched_folders() -> list[Path]:
    """Return the folders where Mitsuba looks for files and plugins, in order."""
    return [Path(str(folder)) for folder in mi.file_resolver()]


@contextlib.contextmanager
def search_folder_first(folder: str) -> Iterator[None]:
    """Let Mitsuba look for files in a folder first, as ``mi.load_file`` does for the scene's.

    ``<path>`` tags extend the search, too; all of that ends with the block.
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
    """Return where Mitsuba's own plugins are: beside its package, or above it in a build tree."""
    for folder in Path(mi.__file__).resolve().parents[:3]:
        if any((folder / FOLDER / f"principled{suffix}").is_file() for suffix in SUFFIXES):
            return folder
    raise SvuEnvironmentError(
        f"{mi.__file__}: this Mitsuba has no plugins folder; install it again."
    )


def _is_own(path: Path) -> bool:
    return Path(os.path.realpath(path)).parent == _own_folder() / FOLDER


def _libraries(name: str) -> list[str]:
    """Return the files that Mitsuba looks for, by its own rules about suffixes."""
    path = mi.filesystem.path
    return [str((path(FOLDER) / path(name)).replace_extension(path(end))) for end in SUFFIXES]


def _names(folder: Path) -> list[str]:
    """Return the names in a folder, none if it cannot be listed (types are looked at, too)."""
    try:
        return sorted(os.listdir(folder))
    except OSError:
        return []

"""Files of a capture: safe paths, folders of photographs and masks, lines of text."""

import contextlib
import os
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from svu_mi.capture.image_formats.recognition import SUFFIXES
from svu_mi.capture.match_photographs import list_pictures, masks_of
from svu_mi.core.identifiers import fits_file_name
from svu_mi.core.io.files import refusing
from svu_mi.errors import CaptureError, counted, excerpt

LONGEST_PATH = 2048  # bytes
CONTROL = re.compile(r"[\0-\x1f\x7f-\x9f]")  # invalid in names, and executed by terminals
SHOWN = 60  # characters of a name in a message
NO_NAME = "not a valid file name; rename the file."
TAIL = 4  # last parts of a path of another machine that are looked for
LARGEST_TEXT = 2**24  # bytes


def safe_path(root: Path, name: Any, label: str) -> Path:
    r"""Return the path of a file from its name, which is absolute or relative to a folder.

    The file need not exist. ``\`` also separates folders, as on Windows. Links are allowed: the
    owner of the folder made them. Paths that lead out of the folder raise CaptureError, whose
    message begins with ``label`` (file and frame).
    """
    parts = _parts(root, name, label)
    base = os.path.abspath(root)
    full = os.path.normpath(os.path.join(base, *parts))
    if PureWindowsPath(name).drive or not Path(full).is_relative_to(base):
        raise CaptureError(
            f"{label}: {excerpt(ascii(name), SHOWN)} lies outside {root}; move the file into it "
            "and give its path relative to that folder."
        )
    path = root / Path(full).relative_to(base)
    if path == root:
        raise CaptureError(f"{label}: {excerpt(ascii(name), SHOWN)} is {NO_NAME}")
    return path


def find_file(
    root: Path, name: Any, label: str, suffixes: Sequence[str] = ("",), *, moved: bool = False
) -> Path:
    """Return the file with a name that another program or machine may have written.

    It is the file at ``safe_path``, or one whose name differs only in case or Unicode form. The
    last parts of names that lead out of the folder (with ``moved``: of all names) are also looked
    for below the folder and its subfolders. Without a match the result is ``safe_path``, which
    may raise CaptureError. Use ``substitutions`` to report other places.
    """
    parts = [part for part in _parts(root, name, label) if part not in ("/", "//", "..")]
    if PureWindowsPath(name).drive:
        parts = [*PureWindowsPath(name).parts[1:]] or parts
    try:
        given = safe_path(root, name, label)
    except CaptureError:
        given = None
    if given is not None:
        found = _existing(root, given.relative_to(root).parts, suffixes)
        if found is not None or not moved:
            return found or given
    tails = [parts[-count:] for count in range(min(len(parts), TAIL), 0, -1)]
    for folders in ([root], _children(root, None)):
        for tail in tails:
            every = [_existing(folder, tail, suffixes) for folder in folders]
            files = [file for file in every if file is not None]
            if len(files) == 1:
                return files[0]
    return safe_path(root, name, label) if given is None else given


def substitutions(label: str, root: Path, pairs: Sequence[tuple[str, Path]]) -> list[str]:
    """Return a sentence about files that are not where their names say.

    Args:
        label: name of the file that contains the names.
        root: folder that names are relative to.
        pairs: names, and the files that ``find_file`` returned for them.

    Raises:
        CaptureError: two names lead to the same file.
    """
    others = [(name, file) for name, file in pairs if not _is_at(root, name, file)]
    if not others:
        return []
    owner: dict[Path, str] = {}
    for name, file in pairs:
        if owner.setdefault(file, name) != name:
            raise CaptureError(
                f"{label}: {excerpt(ascii(owner[file]), SHOWN)} and {excerpt(ascii(name), SHOWN)} "
                f"would both be {file}; move the files to the paths in {label}."
            )
    name, file = others[0]
    return [
        f"{label}: {len(others)} of {len(pairs)} files are not at the given paths, first "
        f"{excerpt(ascii(name), SHOWN)}; {relative_name(root, file)} is used."
    ]


def _parts(root: Path, name: Any, label: str) -> tuple[str, ...]:
    """Return the parts of a name, as a path; raise CaptureError if it is no name of a file."""
    if not isinstance(name, str):
        raise CaptureError(f"{label}: a file's name must be text, got a {type(name).__name__}.")
    parts = PurePosixPath(os.path.normpath(name.replace("\\", "/"))).parts
    is_short = all(map(fits_file_name, parts)) and len(os.fsencode(root / name)) <= LONGEST_PATH
    if not name or not parts or not is_short or CONTROL.search("".join(parts)):
        raise CaptureError(f"{label}: {excerpt(ascii(name), SHOWN)} is {NO_NAME}")
    return parts


def _existing(folder: Path, parts: Sequence[str], suffixes: Sequence[str]) -> Path | None:
    """Return the file with exactly this name, else the only one that is equal but for its form."""
    path = folder.joinpath(*parts)
    exact = (path.with_name(path.name + suffix) for suffix in suffixes)
    if found := next((file for file in exact if file.is_file()), None):
        return found
    *above, last = parts
    for part in above:
        if not (folder / part).is_dir():
            similar = [child for child in _children(folder, _form(part)) if child.is_dir()]
            if len(similar) != 1:
                return None
            part = similar[0].name
        folder = folder / part
    forms = {_form(last + suffix) for suffix in suffixes}
    siblings = [file for form in forms for file in _children(folder, form) if file.is_file()]
    return siblings[0] if len(siblings) == 1 else None


def _form(name: str) -> str:
    """Return a name without case, in one form of Unicode."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _children(folder: Path, form: str | None) -> list[Path]:
    """Return the children of a folder whose name has a form; its subfolders if None."""
    with contextlib.suppress(OSError):
        return _listing(folder, folder.stat().st_mtime_ns).get(form, [])
    return []


@lru_cache(maxsize=64)  # of thousands of photographs, each is looked for
def _listing(folder: Path, _: int) -> dict[str | None, list[Path]]:
    """Return the children of a folder, last changed at a time, by ``form`` of ``_children``."""
    children = sorted(folder.iterdir())
    listed: dict[str | None, list[Path]] = {None: [each for each in children if each.is_dir()]}
    for child in children:
        listed.setdefault(_form(child.name), []).append(child)
    return listed


def _is_at(root: Path, name: str, file: Path) -> bool:
    """Return whether a file is at its name, apart from a suffix that the name lacks."""
    try:
        given = safe_path(root, name, "")
    except CaptureError:
        return False
    return file.parent == given.parent and file.name.startswith(given.name)


def relative_name(root: Path, file: Path) -> str:
    """Return the path of a file relative to a folder; its name if it is elsewhere."""
    return file.relative_to(root).as_posix() if file.is_relative_to(root) else file.name


def find_folder(kind: str, asked: Path | None, places: Iterable[Path]) -> Path | None:
    """Return the folder of ``images`` or ``masks``: ``asked``, or the first that exists."""
    if asked is None:
        return next((place for place in places if place.is_dir()), None)
    if not asked.is_dir():
        raise missing_folder(kind, asked)
    return asked


def missing_folder(kind: str, folder: Path) -> CaptureError:
    """Return the error for a missing folder of ``images`` or ``masks``."""
    what = "photographs" if kind == "images" else kind
    return CaptureError(f"{folder}: no such folder; give the folder of the {what} with --{kind}.")


def find_photographs(
    root: Path, asked: Path | None, names: Sequence[str], poses: Path, count: int
) -> list[Path]:
    """Return the photographs for poses without file names, sorted by name.

    They are in the folder ``asked``, or in the first existing one of ``names`` below ``root``.
    """
    folder = find_folder("images", asked, (root / name for name in names))
    if folder is None:
        raise missing_folder("images", root / names[0])
    files = list_pictures(folder)
    if len(files) != count:
        raise CaptureError(
            f"{folder}: has {counted(len(files), 'photograph')}, but {poses} has "
            f"{counted(count, 'pose')}; give a folder with only the posed "
            "photographs with --images."
        )
    return files


def find_mask(folder: Path, name: Path) -> Path | None:
    """Return the mask of the photograph ``name`` (a relative path) in a folder, or None.

    The mask of ``a.jpg`` is ``a_mask`` (Metashape) or ``mask_a`` with any suffix, ``a.jpg.png``,
    ``a.jpg``, or ``a`` with any suffix.
    """
    marked, own = (
        [folder / name.with_name(stem + suffix) for stem in stems for suffix in SUFFIXES]
        for stems in (masks_of(name.stem), (name.stem,))
    )
    names = (*marked, folder / f"{name}.png", folder / name, *own)
    return next((file for file in names if file.is_file()), None)


def find_masks(folder: Path | None, names: Sequence[Path]) -> list[Path | None]:
    """Return the masks of photographs (see ``find_mask``); raise if the folder has none of them."""
    masks = [None if folder is None else find_mask(folder, name) for name in names]
    require_masks(folder, masks, names)
    return masks


def require_masks(folder: Path | None, masks: Sequence[Any], names: Sequence[Path]) -> None:
    """Raise if a given folder has the mask of no photograph."""
    if folder is not None and not any(masks):
        raise CaptureError(
            f"{folder}: has no mask of {names[0].name} or any other photograph; name masks like "
            "their photographs, or a_mask.png for a.jpg, or give their folder with --masks."
        )


def read_lines(path: Path, what: str, fix: str) -> Iterator[tuple[int, str]]:
    """Yield each non-empty line of a file without comments (``#``): its number and its text.

    Files that are missing, larger than 16 MiB or not text raise CaptureError; its message contains
    ``what``, such as ``a list of exposures``, and the remedy ``fix``.
    """
    with refusing(f"{path}: not {what} that can be read", fix):
        if path.stat().st_size > LARGEST_TEXT:
            raise ValueError("more than 16 MiB")
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].strip()
        if text:
            yield number, text

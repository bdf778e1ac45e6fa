"""List of captures of a batch: subfolders, or rows of a CSV table."""

import csv
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from svu_mi.capture.capture_folder import FILE
from svu_mi.core.identifiers import fits_file_name
from svu_mi.errors import CaptureError, OptionError, OutputError, excerpt

# Optional columns of a table other than "name": options of the commands.
OPTIONS = ("resolution", "preset", "light", "images", "shape")
PATHS = ("light", "images")
INDEX, TABLE = "index.html", "index.csv"  # next to the folders of results
NAME = re.compile(r"[\w][\w .+-]*")  # valid names of folders of results
SIZE = re.compile(r"[1-9][0-9]*(\s+[1-9][0-9]*)?")
LONGEST = 80


@dataclass(frozen=True)
class BatchItem:
    """Capture of a batch.

    Attributes:
        name: Name of its result folder.
        capture: Path of the capture folder or Mitsuba scene.
        options: Values of command-line options, by name without dashes.
    """

    name: str
    capture: Path
    options: dict[str, str] = field(default_factory=dict)


def read_list(path: Path) -> list[BatchItem]:
    """Read the captures of a folder or a CSV table.

    A subfolder is a capture if it contains a ``capture.json`` or one Mitsuba scene. A table has a
    column ``capture``, paths relative to the table, and optional columns ``name`` and ``OPTIONS``.
    """
    if path.is_dir():
        items = _read_folder(path)
    elif path.is_file():
        items = _read_table(path)
    else:
        raise CaptureError(f"{path}: no such folder or table of captures.")
    if not items:
        need = (
            f"subfolders with {FILE} or one scene.xml" if path.is_dir() else "one row per capture"
        )
        raise CaptureError(f"{path}: contains no captures; expected {need}.")
    _require_names(path, items)
    return items


def require_separate(output: Path, items: Sequence[BatchItem]) -> None:
    """Refuse an output folder whose results would overlap the files of captures."""
    captures = {real_path(item.capture) for item in items if item.capture.is_dir()}
    places = {place for item in items for place in capture_paths(item)}
    for item in items:
        results = real_path(output / item.name)
        if overlap := captures & {results, *results.parents} or places & {results}:
            raise OutputError(
                f"{output}: results of {excerpt(item.name, LONGEST)} would overlap the files of "
                f"the capture {excerpt(min(overlap))}; choose another folder with -o."
            )


def capture_paths(item: BatchItem) -> list[Path]:
    """Return the files and folders of a capture, except scenes named in ``capture.json``."""
    capture = item.capture if item.capture.is_dir() else item.capture.parent
    given = [Path(item.options[name]) for name in PATHS if name in item.options]
    return [real_path(path) for path in (capture, *given)]


def real_path(path: Path) -> Path:
    """Return a path without links; ``Path.resolve`` raises on cyclic links."""
    return Path(os.path.realpath(path))


def _read_folder(folder: Path) -> list[BatchItem]:
    items = []
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not path.name.startswith("."):
            scenes = list(path.glob("*.xml"))
            if (path / FILE).is_file():
                items.append(BatchItem(path.name, path))
            elif len(scenes) == 1:
                items.append(BatchItem(path.name, scenes[0]))
    return items


def _read_table(path: Path) -> list[BatchItem]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            rows = [[word.strip() for word in row] for row in csv.reader(stream)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CaptureError(f"{path}: not a readable table; save it as CSV in UTF-8.") from error
    head = rows[0] if rows else []
    unknown = [word for word in head if word not in ("capture", "name", *OPTIONS)]
    if "capture" not in head or unknown or len(set(head)) < len(head):
        cause = f"the column {excerpt(unknown[0], LONGEST)!r}" if unknown else "other columns"
        raise OptionError(
            f"{path}: has {cause}; its first line must name the columns: capture "
            f"and, optionally, name, {', '.join(OPTIONS)}, each once."
        )
    return [_parse_row(path, k, head, row) for k, row in enumerate(rows[1:], 2) if any(row)]


def _parse_row(table: Path, line: int, head: Sequence[str], cells: Sequence[str]) -> BatchItem:
    row, beyond = dict(zip(head, cells, strict=False)), "".join(cells[len(head) :])
    word = row.get("capture", "")
    capture = table.parent / word
    default = capture.parent.name if capture.suffix == ".xml" else capture.resolve().name
    name = row.get("name") or default
    options = {key: row[key] for key in OPTIONS if row.get(key)}
    size = options.get("resolution", "1")
    for value, fine, problem in (
        (beyond, not beyond,
         "is in no column; put a cell that contains commas in quotation marks."),
        (word, word and capture.exists(),
         "is not a capture; give the path of a folder or scene, relative to the table."),
        (name, NAME.fullmatch(name),
         "is not a valid folder name; use letters, digits, spaces and . + - _ in the column name."),
        (size, SIZE.fullmatch(size),
         "is not a resolution; give one or two whole numbers, such as 512 or 1024 512."),
    ):  # fmt: skip
        if not fine:
            raise OptionError(f"{table}, line {line}: {excerpt(value, LONGEST)!r} {problem}")
    paths = {key: str(table.parent / options[key]) for key in PATHS if key in options}
    return BatchItem(name, capture, options | paths)


def _require_names(path: Path, items: Sequence[BatchItem]) -> None:
    names = [item.name.casefold() for item in items]  # some file systems ignore case
    for number, name in enumerate(names):
        reasons = {
            "reserved": name in (INDEX, TABLE), "too long": not fits_file_name(name),
            "used twice": name in names[:number],
        }  # fmt: skip
        if reason := next((reason for reason, holds in reasons.items() if holds), None):
            raise OptionError(
                f"{path}: the capture name {excerpt(items[number].name, LONGEST)!r} is {reason}; "
                "rename the capture, or change its entry in the column name of the table."
            )

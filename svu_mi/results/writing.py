"""Results that are whole: written into a draft, then put in their place.

    with writing("out", "entropy", "run.json", capture=key) as draft:
        write_maps(estimate, draft.folder)
        write_manifest(draft.folder / "run.json", {**record, **draft.entries()})

The draft is a hidden folder inside the result's. When the block is done it gets another name in
one step, and from then on the new result counts: whatever is left to be moved is moved by the next
that comes, a writer or a reader (``settle``).
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from svu_mi.errors import CaptureError, OutputError, SvuWarning, excerpt
from svu_mi.files import is_temporary_of_dead, prepare_folder, read_json, stamped, write_json
from svu_mi.results.lock import LOCK, locked
from svu_mi.results.record import BESIDE, RESULT, Entry, digest_of, entries, is_inside

DRAFT, READY, JOURNAL = ".svu-draft-", ".svu-ready-", ".journal.json"
IGNORED = {LOCK, ".DS_Store", "Thumbs.db"}
PATIENCE = 10.0  # seconds that a reader waits for files that are being moved
RUN, CAPTURE = "svu:run", "svu:capture"  # header entries of every EXR


@dataclass(frozen=True, kw_only=True)
class Draft:
    """A result that is being written.

    Attributes:
        folder: where its files go, the record last.
        target: where they will be.
        run: id of the run, 16 hexadecimal digits.
        command: that writes it.
        capture: key of the capture that it is about, or empty.
        earlier: results that lie in the target.
    """

    folder: Path
    target: Path
    run: str
    command: str
    capture: str
    earlier: tuple[Entry, ...]

    def entries(self) -> dict[str, Any]:
        """Return what the record says of the files: those of the draft, and others beside them.

        To be called when everything but the record is written.
        """
        files = {name: digest_of(self.folder / name) for name in names_in(self.folder)}
        mine = Entry(run=self.run, command=self.command, capture=self.capture, files=files)
        beside = []
        for entry in self.earlier:
            left = {name: digest for name, digest in entry.files.items() if name not in files}
            if entry.command != self.command and left:
                beside.append({**asdict(entry), "files": left})
        return {RESULT: asdict(mine), BESIDE: beside}


@contextlib.contextmanager
def claimed(folder: str | Path, who: str, *, tidy: bool = False) -> Iterator[Path]:
    """Keep a folder for one command, from before its work until after its results.

    The folder is made if missing; what killed runs have left there is cleared or completed.

    Args:
        folder: where results will go.
        who: what others are told is at work, such as ``svu recover``.
        tidy: remove a folder that was made for it, if nothing was put there.

    Raises:
        OutputError: nothing can be written there, or another process is at work there.
    """
    existed = Path(folder).exists()
    folder = prepare_folder(folder)
    try:
        with locked(folder, who):
            _complete(folder)
            _sweep(folder)
            yield folder
    finally:
        if tidy and not existed:
            with contextlib.suppress(OSError):
                folder.rmdir()  # only if it is empty


@contextlib.contextmanager
def writing(
    folder: str | Path,
    command: str,
    record: str,
    *,
    capture: str = "",
    consumed: Sequence[str] = (),
) -> Iterator[Draft]:
    """Give a draft that becomes the result in a folder when the block succeeds.

    Files of the same command's last result that are not written again are removed, if they are as
    they were written. A file that is no run's own, or was changed since, is kept under another
    name.

    Args:
        folder: where the result will lie; made if missing.
        command: that writes it: entropy, recover, ...
        record: name of the JSON file that the block writes last, with ``draft.entries()``.
        capture: key of the capture that it is about.
        consumed: files of the folder that are of no use any more when the result is there.

    Raises:
        OutputError: the folder cannot be written, or another process writes there.
    """
    with claimed(folder, f"svu {command}") as target:
        run = secrets.token_hex(8)
        draft = Draft(
            folder=target / f"{DRAFT}{run}", target=target, run=run, command=command,
            capture=capture, earlier=tuple(entries(target / record)),
        )  # fmt: skip
        try:
            draft.folder.mkdir()
            with stamped({RUN: run, CAPTURE: capture} if capture else {RUN: run}):
                yield draft
            _put_in_place(draft, record, consumed)
        except OutputError as error:
            # Nobody has asked for a file in the draft.
            sentence = str(error).replace(f"{draft.folder}{os.sep}", f"{target}{os.sep}")
            raise OutputError(sentence) from error
        except OSError as error:
            raise OutputError(
                f"{target}: cannot be written ({error.strerror or type(error).__name__}); nothing "
                "there was changed."
            ) from error
        finally:
            shutil.rmtree(draft.folder, ignore_errors=True)


@contextlib.contextmanager
def exchanging(
    folder: str | Path, command: str, record: str, caches: Sequence[str] = ()
) -> Iterator[Draft]:
    """Give a draft as ``writing``, of a result that has its folder to itself (``require_own``)."""
    with claimed(folder, f"svu {command}", tidy=True) as target:
        require_own(target, command, record, caches)
        with writing(target, command, record) as draft:
            yield draft


def require_own(folder: str | Path, command: str, record: str, caches: Sequence[str] = ()) -> None:
    """Refuse a folder that holds anything but an earlier result of a command.

    Args:
        folder: need not exist.
        command: that is about to write there.
        record: name of its record.
        caches: names of files that may be lost, because they are made again.

    Raises:
        OutputError: it holds something else, or a file was changed since.
    """
    folder = Path(folder)
    if not folder.is_dir():
        return
    settle(folder)
    earlier = [entry for entry in entries(folder / record) if entry.command == command]
    allowed = {record, *caches} if earlier else set()
    for name in names_in(folder, empty=True):
        if name in allowed or name in IGNORED or is_temporary_of_dead(Path(name)):
            continue
        if name.startswith(DRAFT) or any(entry.owns(folder, name) for entry in earlier):
            continue
        what = f"was not written by svu {command}"
        if any(name in entry.files for entry in earlier):
            what = f"was changed since svu {command} wrote it"
        raise OutputError(
            f"{folder}: holds other files: {excerpt(name)} {what}; choose another folder, or empty "
            "this one."
        )


def settle(folder: str | Path) -> None:
    """Complete a result that a killed run had finished writing but not moved to its place.

    Every reader of a folder calls this first; it costs one look into the folder.

    Raises:
        OutputError: it cannot be completed, as the folder is read only, or is being written.
    """
    folder = Path(folder)
    if _ready(folder):
        with locked(folder, "svu", wait=PATIENCE):
            _complete(folder)


def names_in(folder: Path, *, empty: bool = False) -> list[str]:
    """Return the files below a folder, with slashes; a link to a folder counts as a file.

    Args:
        folder: to look into.
        empty: name folders without anything in them, too.
    """
    found = []
    for root, folders, files in os.walk(folder):
        here = Path(root)
        found += [here / name for name in (*files, *folders) if not is_folder(here / name)]
        if empty and here != folder and not (files or folders):
            found.append(here)
    return sorted(path.relative_to(folder).as_posix() for path in found)


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder itself, and no link to one."""
    return path.is_dir() and not path.is_symlink()


def _put_in_place(draft: Draft, record: str, consumed: Sequence[str]) -> None:
    """Say what is to be moved and removed, make the draft count, and do it."""
    new = names_in(draft.folder)
    if record not in new:
        raise OutputError(f"{draft.target / record}: was not written.")
    old = {n for e in draft.earlier if e.command == draft.command for n in e.files
           if n not in new and e.owns(draft.target, n)}  # fmt: skip
    journal = {
        "record": record,
        "remove": sorted(old | {n for n in consumed if (draft.target / n).is_file()}),
        "keep": _kept(draft, new, record),
    }
    write_json(draft.folder / JOURNAL, journal)
    ready = draft.target / f"{READY}{draft.run}"
    draft.folder.rename(ready)
    _move(draft.target, ready)


def _kept(draft: Draft, new: Sequence[str], record: str) -> dict[str, str]:
    """Return other names for files that would be overwritten and are no run's own."""
    kept: dict[str, str] = {}
    for name in new:
        path = draft.target / name
        if is_folder(path):
            raise OutputError(f"{path}: is a folder; remove it, or choose another folder.")
        if not os.path.lexists(path) or any(e.owns(draft.target, name) for e in draft.earlier):
            continue
        if name == record and draft.earlier:
            continue
        kept[name] = _free(path).relative_to(draft.target).as_posix()
        warnings.warn(
            f"{path}: not written by svu, or changed since; kept as {kept[name]}.",
            SvuWarning,
            stacklevel=6,
        )
    return kept


def _free(path: Path) -> Path:
    """Return a name for an older file that nobody has: ``map.before.exr``, ..."""
    for number in range(10**6):
        other = path.with_name(f"{path.stem}.before{number or ''}{path.suffix}")
        if not os.path.lexists(other):
            return other
    raise OutputError(f"{path}: cannot be kept under another name; move it away.")


def _ready(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as found:
            names = [e.name for e in found if re.fullmatch(rf"{READY}[0-9a-f]{{16}}", e.name)]
    except OSError:
        return []
    return [folder / name for name in sorted(names)]


def _complete(folder: Path) -> None:
    for ready in _ready(folder):
        try:
            _move(folder, ready)
        except OSError as error:
            raise OutputError(
                f"{folder}: the result of a run that was stopped cannot be completed "
                f"({error.strerror or type(error).__name__}); give the folder back its permissions."
            ) from error


def _move(folder: Path, ready: Path) -> None:
    """Do what is left of the journal; may be stopped and begun again at any point."""
    journal = _journal(ready)
    if journal is not None:
        for name, other in journal["keep"].items():
            if (ready / name).exists() and not os.path.lexists(folder / other):
                with contextlib.suppress(FileNotFoundError):
                    (folder / name).rename(folder / other)
        for name in journal["remove"]:
            (folder / name).unlink(missing_ok=True)
            _remove_if_empty((folder / name).parent, folder)
        names = [name for name in names_in(ready) if name not in (JOURNAL, journal["record"])]
        for name in (*names, journal["record"]):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):  # moved before
                (ready / name).replace(folder / name)
    shutil.rmtree(ready, ignore_errors=True)


def _journal(ready: Path) -> dict[str, Any] | None:
    """Return what is to be done; None when nothing is left, as the journal is removed last.

    The folder may be a stranger's: nothing outside it is touched.

    Raises:
        OutputError: it is no journal, or names something outside.
    """
    path, folder = ready / JOURNAL, ready.parent
    if ready.is_symlink() or not path.is_file():
        return None
    try:
        found = read_json(path)
        names = [found["record"], *found["remove"], *found["keep"], *found["keep"].values()]
    except (CaptureError, KeyError, TypeError, AttributeError):
        names = [None]
    for name in (*names, *names_in(ready)):
        inside = is_inside(name)
        if not inside or not (folder / name).parent.resolve().is_relative_to(folder.resolve()):
            raise OutputError(
                f"{ready}: its {JOURNAL} is not one of svu; remove this folder, and compute the "
                "result again."
            )
    return dict(found)


def _sweep(folder: Path) -> None:
    """Remove what killed runs have left; nobody else writes, as the folder is locked."""
    with contextlib.suppress(OSError):
        for path in list(folder.iterdir()):
            if re.fullmatch(rf"{DRAFT}[0-9a-f]{{16}}", path.name) and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            elif is_temporary_of_dead(path):
                path.unlink(missing_ok=True)


def _remove_if_empty(place: Path, folder: Path) -> None:
    with contextlib.suppress(OSError):
        if place != folder:
            place.rmdir()

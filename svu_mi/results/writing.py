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
import json
import os
import re
import secrets
import shutil
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from svu_mi.errors import OutputError, excerpt
from svu_mi.files import (
    clear_temporaries,
    is_temporary_of_dead,
    prepare_folder,
    stamped,
)
from svu_mi.results.keeping import say_kept, unused_name
from svu_mi.results.lock import LOCK, locked
from svu_mi.results.record import (
    BESIDE,
    CAPTURE,
    LIGHT,
    LIGHT_RECORD,
    RECORDS,
    RESULT,
    RUN,
    Entry,
    digest_of,
    entries,
    entries_in,
    link_above,
)
from svu_mi.results.settling import (
    JOURNAL,
    READY,
    complete,
    is_folder,
    names_in,
    walk,
)
from svu_mi.results.unfinished import begun, prepare

DRAFT = ".svu-draft-"
IGNORED = {LOCK, ".DS_Store", "Thumbs.db"}


@dataclass(frozen=True, kw_only=True)
class Draft:
    """A result that is being written.

    Attributes:
        folder: where its files go, the record last.
        target: where they will be.
        run: id of the run, 16 hexadecimal digits.
        command: that writes it.
        capture: key of the capture that it is about, or empty.
        earlier: results that its record names.
        known: those that any record in the target names.
    """

    folder: Path
    target: Path
    run: str
    command: str
    capture: str
    earlier: tuple[Entry, ...]
    known: tuple[Entry, ...]

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
        with locked(folder, who) as alone:
            complete(folder)
            if alone:
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
    key: str = "",
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
        consumed: files of the folder that are no longer needed when the result is there.
        key: says what is being made, as 16 hexadecimal digits: the draft is kept if the block
            fails, and given again to the next that makes the same. Without one it is removed.

    Raises:
        OutputError: the folder cannot be written, or another process writes there.
    """
    with claimed(folder, f"svu {command}") as target:
        run = secrets.token_hex(8)
        place = target / f"{DRAFT}{run}"
        if key:
            run, place = begun(target, run, key)
        draft = Draft(
            folder=place, target=target, run=run, command=command,
            capture=capture, earlier=tuple(entries(target / record)),
            known=tuple(entries_in(target)),
        )  # fmt: skip
        try:
            draft.folder.mkdir(exist_ok=bool(key))
            with stamped({RUN: run, CAPTURE: capture} if capture else {RUN: run}):
                yield draft
            ready = _make_count(draft, record, consumed)
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
            if not (key and is_folder(draft.folder) and names_in(draft.folder)):
                shutil.rmtree(draft.folder, ignore_errors=True)
        complete(target, ready)


@contextlib.contextmanager
def exchanging(
    folder: str | Path, command: str, record: str, caches: Sequence[str] = (), *,
    key: str = "", resume: bool = False,
) -> Iterator[Draft]:  # fmt: skip
    """Give a draft as ``writing``, of a result that has its folder to itself (``require_own``).

    With a ``key`` the draft is kept if the block fails; with ``resume`` one that was kept is given.
    All others that were kept are removed.
    """
    with claimed(folder, f"svu {command}", tidy=True) as target:
        require_own(target, command, record, caches)
        prepare(target, key, resume)
        with writing(target, command, record, key=key) as draft:
            yield draft


def require_own(folder: Path, command: str, record: str, caches: Sequence[str] = ()) -> None:
    """Refuse a folder that holds anything but an earlier result of a command.

    Light that was found in a capture may lie below it: whether it still fits, its key tells.

    Args:
        folder: that is locked.
        command: that is about to write there.
        record: name of its record.
        caches: names of files that may be lost, because they are made again.

    Raises:
        OutputError: it holds something else, or a file was changed since.
    """
    earlier = [entry for entry in entries(folder / record) if entry.command == command]
    allowed = {record, *caches} if earlier else set()
    for name in walk(folder, empty=True):
        if name in allowed or name in IGNORED or is_temporary_of_dead(Path(name)):
            continue
        if name.startswith(DRAFT) or any(entry.owns(folder, name) for entry in earlier):
            continue
        if _is_of_light_below(folder, name):
            continue
        what = f"was not written by svu {command}, or by an older version of it"
        if writer := _writer(folder, name):
            what = f"was written by svu {excerpt(writer, 40)}"
        if any(name in entry.files for entry in earlier):
            what = f"was changed since svu {command} wrote it"
        raise OutputError(
            f"{folder}: holds other files: {excerpt(name)} {what}; choose another folder, or "
            "empty this one."
        )


def _is_of_light_below(folder: Path, name: str) -> bool:
    """Return whether a file is of light that was found and kept here: it is known by its key."""
    top, _, rest = name.partition("/")
    place = folder / top
    own = [e for e in entries(place / LIGHT_RECORD) if e.command == LIGHT] if rest else []
    return bool(own) and (rest == LIGHT_RECORD or any(e.owns(place, rest) for e in own))


def _writer(folder: Path, name: str) -> str | None:
    """Return which command has written a file, as the records of its folder say."""
    for record in RECORDS:
        for entry in entries(folder / record):
            if name == record or name in entry.files:
                return entry.command
    return None


def _make_count(draft: Draft, record: str, consumed: Sequence[str]) -> Path:
    """Say what is to be moved and removed, and give the draft the name that makes it count."""
    new = names_in(draft.folder)
    if record not in new:
        raise OutputError(f"{draft.target / record}: was not written.")
    old = {name for e in draft.earlier if e.command == draft.command for name in e.files}
    own = {name for name in {*old, *new} if any(e.owns(draft.target, name) for e in draft.known)}
    written = {name.casefold() for name in new}  # some systems know no case
    gone = {name for name in own - set(new) if name.casefold() not in written}
    journal = {
        "record": record,
        "remove": sorted(gone | {name for name in consumed if (draft.target / name).is_file()}),
        "keep": _kept(draft, new, own),
    }
    (draft.folder / JOURNAL).write_text(json.dumps(journal), encoding="utf-8")
    ready = draft.target / f"{READY}{draft.run}"
    draft.folder.rename(ready)
    return ready


def _kept(draft: Draft, new: Sequence[str], own: Collection[str]) -> dict[str, str]:
    """Return other names for what is in the way of the new files and is no run's own."""
    kept: dict[str, str] = {}
    for name in new:
        path = link_above(draft.target, name) or draft.target / name
        at = path.relative_to(draft.target).as_posix()
        if is_folder(path):
            raise OutputError(f"{path}: is a folder; remove it, or choose another folder.")
        if at in kept or at in own or not os.path.lexists(path) or _is_record(draft, at):
            continue
        kept[at] = unused_name(path).relative_to(draft.target).as_posix()
    if kept:
        old, other = next(iter(kept.items()))
        say_kept(draft.target, old, other, len(kept) - 1)
    return kept


def _is_record(draft: Draft, name: str) -> bool:
    """Return whether a file is a record, which no entry lists, but which has some of its own."""
    return name in RECORDS and bool(draft.earlier)


def _sweep(folder: Path) -> None:
    """Remove what killed runs have left; nobody else writes, as the folder is locked."""
    with contextlib.suppress(OSError):
        for path in list(folder.iterdir()):
            if re.fullmatch(rf"{DRAFT}[0-9a-f]{{16}}", path.name) and is_folder(path):
                shutil.rmtree(path, ignore_errors=True)
    clear_temporaries(folder)

"""Results that are complete: written into a draft, then exchanged with the older result.

    with writing("out", "entropy", "run.json", capture=key) as draft:
        write_maps(estimate, draft.folder)
        write_manifest(draft.folder / "run.json", {**record, **draft.entries()})

A result has its folder to itself. Commands claim the folder before their work, and pass the claim
to the writer in place of the folder:

    with claimed("out", "entropy", overwrite=True) as place:
        write_outputs(capture, estimate, place)
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from svu_mi.core.io.files import prepare_folder, replacing, stamped
from svu_mi.core.io.folder_exchange import exchanged, is_at, locked, unused_name
from svu_mi.core.io.hashes import digest_of, digest_of_file
from svu_mi.core.io.provenance import CAPTURE, RESULT, RUN, Entry, entries_in, files_in
from svu_mi.errors import OutputError, SvuWarning, excerpt

# What svu keeps inside of results and captures, whatever is written there: what is found or
# rendered once. Their keys tell whether they are used.
KEPT = ("light", "light-gains", "cache", "capture", "unwrapped.ply")
CHECKPOINT = ".svu-checkpoint.npz"  # in the draft of an interrupted recovery
IGNORED = {".DS_Store", "Thumbs.db"}
# At the end of a page that lies alone, without a record beside it: a digest of all before it.
MARK = re.compile(rb"<!-- svu:page=([0-9a-f]{32}) -->\n\Z")


@dataclass(frozen=True)
class Claim(os.PathLike[str]):
    """A folder that one command writes to, from before its work until its result is there.

    Attributes:
        folder: as it was given.
        target: the same, absolute and without links.
        draft: hidden folder beside it, where files are written.
        command: that writes them.
    """

    folder: Path
    target: Path
    draft: Path
    command: str

    def __fspath__(self) -> str:
        return str(self.folder)

    def clear(self, keep: Callable[[Path], bool] | None = None) -> None:
        """Remove everything from the draft but what is to be kept."""
        for path in list(self.draft.iterdir()) if self.draft.is_dir() else ():
            if keep is None or not keep(path):
                _remove(path)


@dataclass(frozen=True)
class Draft:
    """A result that is being written.

    Attributes:
        folder: where its files go, the record last.
        target: where they will be.
        run: id of the run, 16 hexadecimal digits.
        command: that writes it.
        capture: key of the capture that it is about, or empty.
    """

    folder: Path
    target: Path
    run: str
    command: str
    capture: str

    def entries(self) -> dict[str, Any]:
        """Return what the record says of the files; called when all others are written."""
        files = {name: digest_of_file(self.folder / name) for name in files_in(self.folder)}
        return {RESULT: asdict(Entry(self.run, self.command, self.capture, files))}


@contextlib.contextmanager
def claimed(
    folder: str | os.PathLike[str], command: str, *, overwrite: bool = False, keep: str = ""
) -> Iterator[Claim]:
    """Keep a folder for one command, from before its work until after its result.

    Args:
        folder: where the result will be; its parents are made. A claim is passed on.
        command: that writes it: entropy, recover, ...
        overwrite: accept a folder with anything else in it, which is kept as ``NAME.before``.
        keep: pattern of the files of the draft that outlive a run that fails, to resume it.

    Raises:
        OutputError: nothing can be written there, the folder holds anything but an older result of
            the command, or another process is at work there.
    """
    if isinstance(folder, Claim):
        yield folder
        return
    shown, target = Path(folder), Path(os.path.realpath(folder))
    _require_exchangeable(shown, target)

    def is_needed(path: Path) -> bool:
        return fnmatch(path.name, keep)

    absent = [parent for parent in target.parents if not parent.exists()]
    try:
        _prepare_parent(shown, target)
        with locked(target) as draft:
            if target.exists():
                prepare_folder(target)  # only to see that it is a folder, and may be changed
            if not overwrite and (reason := _stranger_in(target, command)):
                raise _occupied(shown, f"holds other files: {reason}")
            claim = Claim(shown, target, draft, command)
            _carry(draft, target)
            claim.clear(is_needed)
            own = draft.lstat()
            try:
                yield claim
            finally:
                if is_at(own, draft):  # no result was written
                    claim.clear(is_needed)
    finally:
        for parent in absent:  # those that nothing was put into
            with contextlib.suppress(OSError):
                parent.rmdir()


@contextlib.contextmanager
def writing(
    folder: str | os.PathLike[str], command: str, record: str, *, capture: str = "", run: str = ""
) -> Iterator[Draft]:
    """Give a draft that becomes the result in a folder when the block succeeds.

    Args:
        folder: where the result will be, or the claim of it.
        command: that writes it: entropy, recover, ...
        record: name of the JSON file that the block writes last, with ``draft.entries()``.
        capture: key of the capture that it is about.
        run: id of the run; drawn by default.

    Raises:
        OutputError: as ``claimed``, or a file cannot be written.
    """
    run = run or secrets.token_hex(8)
    with claimed(folder, command) as claim:
        marks = {RUN: run, CAPTURE: capture} if capture else {RUN: run}
        try:
            with stamped(marks):
                yield Draft(claim.draft, claim.folder, run, command, capture)
            if not (claim.draft / record).is_file():
                raise OutputError(f"{claim.folder / record}: was not written.")
            _put_in_place(claim)
        except OutputError as error:
            # The user has not asked for a file in the draft.
            sentence = str(error).replace(f"{claim.draft}{os.sep}", f"{claim.folder}{os.sep}")
            raise OutputError(sentence) from error
        except OSError as error:
            raise OutputError(
                f"{claim.folder}: cannot be written ({error.strerror or type(error).__name__}); "
                "nothing there was changed."
            ) from error


def _put_in_place(claim: Claim) -> None:
    """Exchange the draft with the older folder, which is removed, or kept if it is not ours."""
    draft, target = claim.draft, claim.target
    other = _stranger_in(target, claim.command)
    new = draft.rename(unused_name(target)) if other else draft
    with exchanged(new, target):  # from here on, ``new`` names the older folder
        _carry(new, target)
        for path in target.glob(".svu-*"):  # what only a resumed run needs
            _remove(path)
        if not other:
            shutil.rmtree(draft, ignore_errors=True)
    if other:
        _say_kept(claim.folder, new)


def _carry(source: Path, target: Path) -> None:
    """Move what is kept inside of results from one folder to another."""
    for path in list(source.iterdir()) if source.is_dir() and target.is_dir() else ():
        if is_kept(path.name) and not os.path.lexists(target / path.name):
            path.rename(target / path.name)


def is_kept(name: str) -> bool:
    """Return whether svu keeps what has this name in the folder of a capture or a result."""
    return name.partition(".before")[0] in KEPT


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _prepare_parent(folder: Path, target: Path) -> None:
    """Make the folder that a result and its draft lie in, and see that it can be written."""
    try:
        prepare_folder(target.parent)
    except OutputError as error:
        if not target.is_dir():
            raise
        raise OutputError(
            f"{folder}: a result is put together beside its folder, but {error}"
        ) from error


def _require_exchangeable(folder: Path, target: Path) -> None:
    """Refuse a folder that cannot be renamed."""
    if Path.cwd().is_relative_to(target):
        what = "holds the working directory"
    elif target.is_mount() or str(target) in _mounts():
        what = "is the top of a disk or of a mounted folder"
    else:
        return
    raise OutputError(
        f"{folder}: {what}, which cannot be exchanged with a result; choose a folder in it."
    )


def _mounts() -> set[str]:
    """Return where folders are mounted; Linux only: bind mounts are told by nothing else."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/self/mountinfo").read_text(errors="replace").splitlines()
        return {line.split()[4].replace("\\040", " ") for line in lines}
    return set()


def _stranger_in(folder: Path, command: str) -> str:
    """Return which file of a folder is not of an older result of a command; empty if none is."""
    if not folder.exists():
        return ""
    entries = entries_in(folder)
    own = {name: entry for name, entry in entries.items() if entry.command == command}
    for name in files_in(folder):
        top = name.partition("/")[0]
        if is_kept(top) or name in own or name.rpartition("/")[2] in IGNORED:
            continue
        if any(entry.owns(folder, name) for entry in own.values()):
            continue
        writer = next((e.command for r, e in entries.items() if name == r or name in e.files), "")
        what = f"written by svu {excerpt(writer, 40)}"
        if any(name in entry.files for entry in own.values()):
            what = f"changed since svu {command} wrote it"
        elif not writer:
            what = f"not written by svu {command}, or by an older version of it"
        return f"{excerpt(name)} was {what}"
    return ""


def _occupied(folder: Path, reason: str) -> OutputError:
    sentence = f"{folder}: {reason}; choose another name, or"
    kept = unused_name(Path(os.path.realpath(folder))).name
    return OutputError(
        f"{sentence} rename this one.",
        shell=f"{sentence} --overwrite, which keeps this one as {kept}.",
    )


def write_page(path: Path, page: str) -> None:
    """Write an HTML page that has no record beside it, whole or not at all.

    A page of others, or an edited one, is kept under another name, with a warning.

    Args:
        path: the HTML file.
        page: its text, which a comment with a digest is added to.

    Raises:
        OutputError: as ``files.replacing``.
    """
    content = (page + "\n").encode()
    with replacing(path) as temporary:
        temporary.write_bytes(content + f"<!-- svu:page={digest_of(content)} -->\n".encode())
        if not (path.is_dir() or _is_own_page(path)):
            path.rename(kept := unused_name(path))
            _say_kept(path, kept)


def require_own_page(path: Path) -> None:
    """Refuse a page of others, or an edited one.

    Raises:
        OutputError: it is one.
    """
    if not _is_own_page(path):
        raise _occupied(path, "was not written by svu report, or was changed since")


def _is_own_page(path: Path) -> bool:
    """Return whether a page is missing, or as ``write_page`` has written it."""
    if not os.path.lexists(path):
        return True
    content = path.read_bytes() if path.is_file() and not path.is_symlink() else b""
    mark = MARK.search(content)
    return mark is not None and digest_of(content[: mark.start()]) == mark[1].decode()


def _say_kept(path: Path, kept: Path) -> None:
    warnings.warn(
        f"{path}: what was there is kept as {kept.name}; remove it when you no longer need it.",
        SvuWarning,
        stacklevel=6,
    )

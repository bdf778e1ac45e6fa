"""Result folders: written as a hidden draft, then exchanged with the older result in one step.

    with writing("out", "entropy", "run.json", capture=key) as draft:
        write_maps(estimate, draft.folder)
        write_manifest(draft.folder / "run.json", {**record, **draft.entries()})

Each result has its own folder. Commands claim the folder before their work, and pass the claim to
the writer instead of the folder:

    with claimed("out", "entropy", overwrite=True) as place:
        write_outputs(capture, estimate, place)
"""

import contextlib
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from svu_mi.core.io.files import prepare_folder, replacing, stamped
from svu_mi.core.io.folder_exchange import exchanged, is_at, locked, unused_name
from svu_mi.core.io.hashes import digest_of, digest_of_file
from svu_mi.core.io.provenance import CAPTURE, RESULT, RUN, Entry, entries_in, files_in
from svu_mi.errors import OutputError, excerpt, warn

# Names that stay in captures and results when these are replaced: light estimates, renderings and
# unwrapped meshes. Keys inside of them decide whether they are still valid.
KEPT = ("light", "light-gains", "cache", "capture", "unwrapped.ply")
CHECKPOINT = ".svu-checkpoint.npz"  # file in the draft of an interrupted recovery
IGNORED = {".DS_Store", "Thumbs.db"}
# Last line of an HTML page without a record: the digest of the text before it.
MARK = re.compile(rb"<!-- svu:page=([0-9a-f]{32}) -->\n\Z")


@dataclass(frozen=True)
class Claim(os.PathLike[str]):
    """Result folder that is reserved for one command until its result is complete.

    Attributes:
        folder: path of the result folder as given by the user.
        target: absolute path of the result folder, without links.
        draft: path of the hidden folder, next to the result folder, that receives the files.
        command: name of the command.
    """

    folder: Path
    target: Path
    draft: Path
    command: str

    def __fspath__(self) -> str:
        return str(self.folder)

    def clear(self, keep: Callable[[Path], bool] | None = None) -> None:
        """Remove all files from the draft, except those for which ``keep`` returns True."""
        for path in list(self.draft.iterdir()) if self.draft.is_dir() else ():
            if keep is None or not keep(path):
                _remove(path)


@dataclass(frozen=True)
class Draft:
    """Result that is being written.

    Attributes:
        folder: path of the folder for the files; the record is written last.
        target: path of the final folder.
        run: id of the run, 16 hexadecimal digits.
        command: name of the command.
        capture: key of the capture; empty without one.
    """

    folder: Path
    target: Path
    run: str
    command: str
    capture: str

    def entries(self) -> dict[str, Any]:
        """Return the entry of the record that lists all files written so far, with digests."""
        files = {name: digest_of_file(self.folder / name) for name in files_in(self.folder)}
        return {RESULT: asdict(Entry(self.run, self.command, self.capture, files))}


@contextlib.contextmanager
def claimed(
    folder: str | os.PathLike[str], command: str, *, overwrite: bool = False, keep: str = ""
) -> Iterator[Claim]:
    """Reserve a result folder for one command until its result is complete.

    Args:
        folder: path of the result folder; its parents are created. If it is a claim, it is yielded.
        command: name of the command, such as ``entropy``.
        overwrite: True to accept a folder with other files, which is kept as ``NAME.before``.
        keep: name pattern of files in the draft that stay after a failed run, to resume it.

    Raises:
        OutputError: the folder is not writable, contains files that are not an older result of
            the command, or another process is writing there.
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
                prepare_folder(target)  # check that it is a writable folder
            if not overwrite and (reason := _foreign_file(target, command)):
                raise _occupied(shown, f"contains other files: {reason}")
            claim = Claim(shown, target, draft, command)
            _move_kept(draft, target)
            claim.clear(is_needed)
            own = draft.lstat()
            try:
                yield claim
            finally:
                if is_at(own, draft):  # no result was written
                    claim.clear(is_needed)
    finally:
        for parent in absent:  # rmdir fails if it contains a file
            with contextlib.suppress(OSError):
                parent.rmdir()


@contextlib.contextmanager
def writing(
    folder: str | os.PathLike[str], command: str, record: str, *, capture: str = "", run: str = ""
) -> Iterator[Draft]:
    """Yield a draft that becomes the result folder if the block succeeds.

    Args:
        folder: path of the result folder, or its claim.
        command: name of the command, such as ``entropy``.
        record: name of the JSON file that the block writes last, with ``draft.entries()``.
        capture: key of the capture; empty without one.
        run: id of the run; random by default.

    Raises:
        OutputError: an error of ``claimed``, or a file cannot be written.
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
            # Users know the result folder, not the draft.
            sentence = str(error).replace(f"{claim.draft}{os.sep}", f"{claim.folder}{os.sep}")
            raise OutputError(sentence) from error
        except OSError as error:
            raise OutputError(
                f"{claim.folder}: cannot be written ({error.strerror or type(error).__name__}); "
                "nothing there was changed."
            ) from error


def _put_in_place(claim: Claim) -> None:
    """Exchange the draft with the older folder, which is removed if it has no other files."""
    draft, target = claim.draft, claim.target
    other = _foreign_file(target, claim.command)
    new = draft.rename(unused_name(target)) if other else draft
    with exchanged(new, target):  # from here on, ``new`` names the older folder
        _move_kept(new, target)
        for path in target.glob(".svu-*"):  # only needed to resume a run
            _remove(path)
        if not other:
            shutil.rmtree(draft, ignore_errors=True)
    if other:
        _warn_kept(claim.folder, new)


def _move_kept(source: Path, target: Path) -> None:
    """Move the files and folders named in ``KEPT`` from one folder to another."""
    for path in list(source.iterdir()) if source.is_dir() and target.is_dir() else ():
        if is_kept(path.name) and not os.path.lexists(target / path.name):
            path.rename(target / path.name)


def is_kept(name: str) -> bool:
    """Return whether files with this name stay in a folder when its result is replaced."""
    return name.partition(".before")[0] in KEPT


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _prepare_parent(folder: Path, target: Path) -> None:
    """Create the parent folder of a result and its draft; check that it is writable."""
    try:
        prepare_folder(target.parent)
    except OutputError as error:
        if not target.is_dir():
            raise
        raise OutputError(
            f"{folder}: a result needs a temporary folder next to it, but {error}"
        ) from error


def _require_exchangeable(folder: Path, target: Path) -> None:
    """Raise OutputError if a folder cannot be renamed."""
    if Path.cwd().is_relative_to(target):
        what = "contains the working directory"
    elif target.is_mount() or str(target) in _mounts():
        what = "is a mount point"
    else:
        return
    raise OutputError(
        f"{folder}: {what} and cannot be replaced by a result; choose a folder inside."
    )


def _mounts() -> set[str]:
    """Return the mount points, including bind mounts; empty outside of Linux."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/self/mountinfo").read_text(errors="replace").splitlines()
        return {line.split()[4].replace("\\040", " ") for line in lines}
    return set()


def _foreign_file(folder: Path, command: str) -> str:
    """Return why a file is not part of the command's older result; empty if all files are."""
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
            what = f"not written by svu {command}, or by an older version"
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
    """Write an HTML page that has no record, atomically.

    An existing page that was edited, or not written by svu, is renamed, with a warning.

    Args:
        path: path of the HTML file.
        page: text of the page; a comment with its digest is appended.

    Raises:
        OutputError: an error of ``files.replacing``.
    """
    content = (page + "\n").encode()
    with replacing(path) as temporary:
        temporary.write_bytes(content + f"<!-- svu:page={digest_of(content)} -->\n".encode())
        if not (path.is_dir() or _is_own_page(path)):
            path.rename(kept := unused_name(path))
            _warn_kept(path, kept)


def require_own_page(path: Path) -> None:
    """Raise OutputError if a page was edited, or not written by svu."""
    if not _is_own_page(path):
        raise _occupied(path, "was not written by svu report, or was changed since")


def _is_own_page(path: Path) -> bool:
    """Return whether a page is missing, or unchanged since ``write_page``."""
    if not os.path.lexists(path):
        return True
    content = path.read_bytes() if path.is_file() and not path.is_symlink() else b""
    mark = MARK.search(content)
    return mark is not None and digest_of(content[: mark.start()]) == mark[1].decode()


def _warn_kept(path: Path, kept: Path) -> None:
    warn(f"{path}: the older content is kept as {kept.name}; remove it if you do not need it.")

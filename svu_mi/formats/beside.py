"""Photographs and masks that lie in folders beside the poses, which name none of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from svu_mi.capture.picture import SUFFIXES
from svu_mi.errors import CaptureError


def photographs(
    root: Path, asked: Path | None, names: Sequence[str], poses: Path, count: int
) -> list[Path]:
    """Return the photographs of poses, in the order of their names.

    Args:
        root: folder of the poses.
        asked: folder of the photographs that was asked for, or None.
        names: of the folders that they may be in otherwise; the first that there is.
        poses: file of the poses, for the message.
        count: number of the poses.

    Raises:
        CaptureError: there is no such folder, or there are more photographs or fewer.
    """
    folder = _folder(root, asked, names)
    if folder is None or not folder.is_dir():
        raise CaptureError(
            f"{folder or root / names[0]}: no such folder; give that of the photographs with "
            "--images."
        )
    files = pictures(folder)
    if len(files) != count:
        raise CaptureError(
            f"{folder}: has {len(files)} photographs, but {poses} has {count} poses; give the "
            "folder of the photographs that were posed, and no others, with --images."
        )
    return files


def mask_folder(root: Path, asked: Path | None, names: Sequence[str]) -> Path | None:
    """Return the folder of the masks, None if there is none.

    Args:
        root: folder of the poses.
        asked: folder of the masks that was asked for, or None.
        names: of the folders that they may be in otherwise; the first that there is.

    Raises:
        CaptureError: the folder that was asked for is none.
    """
    folder = _folder(root, asked, names)
    if folder is not None and not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder; give that of the masks with --masks.")
    return folder


def pictures(folder: Path) -> list[Path]:
    """Return the pictures in a folder in the order of their names, without hidden files.

    Raises:
        CaptureError: the folder cannot be read.
    """
    try:
        files = sorted(folder.iterdir())
    except OSError as error:
        raise CaptureError(
            f"{folder}: cannot be read ({error.strerror}); change its permissions."
        ) from error
    known = [file for file in files if file.suffix.lower() in SUFFIXES]
    return [file for file in known if not file.name.startswith(".") and file.is_file()]


def mask_of(folder: Path, name: Path) -> Path | None:
    """Return the mask of a photograph: ``a.jpg.png``, ``a.jpg``, or ``a`` with any suffix.

    Args:
        folder: of the masks.
        name: of the photograph, relative to the folder of the photographs.
    """
    stems = [folder / name.with_suffix(suffix) for suffix in SUFFIXES]
    names = (folder / f"{name}.png", folder / name, *stems)
    return next((file for file in names if file.is_file()), None)


def _folder(root: Path, asked: Path | None, names: Sequence[str]) -> Path | None:
    folders = (root / name for name in names)
    return asked or next((folder for folder in folders if folder.is_dir()), None)

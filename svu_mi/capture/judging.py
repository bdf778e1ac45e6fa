"""What is wrong with photographs: one sentence for all that have it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from svu_mi.capture.images import Photograph
from svu_mi.errors import CaptureError

NOT_HDR = {  # by bits, of one photograph and of several
    8: ("an 8-bit image, not HDR; decoded as sRGB, ", "8-bit images, not HDR; decoded as sRGB, "),
    16: ("a 16-bit image, not HDR; decoded as sRGB, ", "16-bit images, not HDR; decoded as sRGB, "),
}
NAMED = 3  # photographs that a sentence names


@dataclass(frozen=True)
class Taken:
    """A photograph that there is.

    Attributes:
        photograph: as read.
        path: its file.
        name: what the user calls it.
    """

    photograph: Photograph
    path: Path
    name: str


def judged(
    photographs: Sequence[Photograph], paths: Sequence[Path | None], names: Sequence[str], *,
    some: bool = False,
) -> tuple[list[str], tuple[bool, ...]]:  # fmt: skip
    """Say what was found in the photographs; leave out those without any light.

    Args:
        photographs: of V views.
        paths: V files; None where there is none, of which nothing is said.
        names: V names that the user knows them by.
        some: these are not all photographs; all of them may be black.

    Returns:
        The sentences, and V booleans: whether a view is used.

    Raises:
        CaptureError: all are black.
    """
    taken = [
        Taken(photograph, path, name)
        for photograph, path, name in zip(photographs, paths, names, strict=True)
        if path is not None
    ]
    used = tuple(not photograph.black for photograph in photographs)
    if taken and not any(used) and not some:
        raise CaptureError(
            f"{taken[0].path.parent}: all {len(taken)} photographs are entirely black; "
            "check the exposure and the channel names of the files."
        )
    return [*_remarks(taken), *_not_hdr(taken), *_invalid(taken), *_black(taken)], used


def _remarks(taken: Sequence[Taken]) -> list[str]:
    remarks = dict.fromkeys(remark for one in taken for remark in one.photograph.remarks)
    found = {remark: [t for t in taken if remark in t.photograph.remarks] for remark in remarks}
    return [
        f"{_subject(those, taken)}{', each' if len(those) > 1 else ''}: {remark}"
        for remark, those in found.items()
    ]


def _not_hdr(taken: Sequence[Taken]) -> list[str]:
    notes = []
    for bits, (one_is, several_are) in NOT_HDR.items():
        if found := [one for one in taken if one.photograph.bits == bits]:
            clipped = sum(one.photograph.saturated for one in found)
            notes.append(
                f"{_subject(found, taken)}: {one_is if len(found) == 1 else several_are}{clipped} "
                "saturated pixels count as at least so bright. Clipped highlights hide gloss: use "
                "HDR."
            )
    return notes


def _invalid(taken: Sequence[Taken]) -> list[str]:
    found = [one for one in taken if one.photograph.invalid]
    if not found:
        return []
    count = sum(one.photograph.invalid for one in found)
    return [
        f"{_subject(found, taken)}: {count} pixels are NaN, infinite or negative; left out."
    ]


def _black(taken: Sequence[Taken]) -> list[str]:
    found = [one for one in taken if one.photograph.black]
    if not found:
        return []
    subject = _subject(found, taken)
    if len(found) == 1:
        return [
            f"{subject}: the photograph is entirely black; the view is left out. Check its "
            "exposure, or remove it with its sensor."
        ]
    return [
        f"{subject}: entirely black; these views are left out. Check their exposure, or remove "
        "them with their sensors."
    ]


def _subject(found: Sequence[Taken], taken: Sequence[Taken]) -> str:
    """Name what a sentence is about: one photograph, or the folder and how many of them."""
    path, name = found[0].path, found[0].name
    if len(found) == 1:
        return str(path) if name == path.name else f"{path} ({name})"
    if len(found) == len(taken):
        return f"{path.parent}: all {len(taken)} photographs"
    rest = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    some = ", ".join(one.name for one in found[:NAMED])
    return f"{path.parent}: {len(found)} of {len(taken)} photographs ({some}{rest})"

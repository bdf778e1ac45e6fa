"""Photographs and poses that occur twice are reported."""

from __future__ import annotations

import numpy as np

from svu_mi.capture.importers.duplicate_frames import duplicate_notes
from svu_mi.capture.importers.source import Frame
from svu_mi.capture.sensors import affine


def frames_of(folder, *photographs):
    """Return frames of (name, content, position along x); only new names are written."""
    frames = []
    for name, content, x in photographs:
        (folder / name).write_bytes(content)
        frames.append(Frame(
            label=f"frame {len(frames)}", image=folder / name, focal=(9.0, 9.0),
            to_world=affine(np.eye(3), np.array([x, 0, 0])), center=(4.0, 3.0), size=(8, 6),
        ))  # fmt: skip
    return frames


def notes_of(folder, *photographs):
    return list(duplicate_notes(frames_of(folder, *photographs), "scan"))


def test_same_photograph_twice(tmp_path):
    photographs = (("a", b"1", 0), ("b", b"2", 1), ("a", b"1", 2), ("c", b"2", 1), ("d", b"2", 4))
    assert notes_of(tmp_path, *photographs) == [
        "scan: 3 of 5 photographs are there twice, first a (frame 0 and frame 2), so the "
        "uncertainty is too small. Remove one of each."
    ]


def test_same_pose_twice(tmp_path):
    assert notes_of(tmp_path, ("a", b"1", 0.0), ("b", b"2", 1), ("c", b"3", -1e-12)) == [
        "scan: 1 of 3 photographs is posed like another, first a and c; if the camera moved "
        "between them, correct the poses."
    ]


def test_other_photographs_of_same_size_are_not_duplicates(tmp_path):
    """Their middle is the same; one differs in its first byte only."""
    black = bytes(20_000)
    assert not notes_of(tmp_path, ("a", black, 0), ("b", b"1" + black[1:], 1), ("c", b"", 2))
    assert not notes_of(tmp_path, ("a", b"1", 0))

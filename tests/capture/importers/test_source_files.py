"""Names in files of other tools: accepted and refused paths."""

from __future__ import annotations

from pathlib import Path

import pytest

from svu_mi.capture.importers.source_files import safe_path
from svu_mi.errors import CaptureError

GOOD = {
    "a.png": "a.png", "./a/b.png": "a/b.png", "a/../b.png": "b.png", "a\\b.png": "a/b.png",
    "..a": "..a", "ü ß.png": "ü ß.png",
}  # fmt: skip
OUTSIDE = ["../a", "..", "a/../../b", "a\\..\\..\\b", "/a", "//a/b", "\\a", "C:\\a", "C:a"]
NO_NAME = [
    "", ".", "a/..", "a\0b", "a\nb", "\x1b[31m", "\x7f", "\ud800", "x" * 300, "a/" * 2000 + "b",
    None, 3, ["a"],
]  # fmt: skip


@pytest.mark.parametrize("name", GOOD)
def test_a_file_inside(name):
    assert safe_path(Path("root"), name, "frame 3") == Path("root", GOOD[name])


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_file_outside(name):
    with pytest.raises(CaptureError, match="frame 3: .* lies outside root; move"):
        safe_path(Path("root"), name, "frame 3")


@pytest.mark.parametrize("name", NO_NAME, ids=range(len(NO_NAME)))
def test_no_name_at_all(name):
    with pytest.raises(CaptureError, match="frame 3: .*name") as error:
        safe_path(Path("root"), name, "frame 3")
    assert len(str(error.value)) < 120 and str(error.value).isascii()

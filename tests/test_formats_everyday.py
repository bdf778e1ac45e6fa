"""What people's files and folders really look like: each case once went wrong."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from svu_mi.errors import OutputError
from svu_mi.files import read_json, replacing_folder

# --- folders ------------------------------------------------------------------------------


def test_a_folder_that_cannot_be_replaced_stays(tmp_path, monkeypatch):
    folder = tmp_path / "capture"
    folder.mkdir()
    (folder / "old").touch()
    rename = Path.rename

    def refused(path: Path, target: Path) -> Path:
        if path.suffix == ".tmp":
            raise OSError(28, "No space left on device")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", refused)
    with pytest.raises(OutputError, match="No space"), replacing_folder(folder, lambda _: True):
        pass
    assert (folder / "old").exists() and list(tmp_path.iterdir()) == [folder]


def test_the_folder_that_a_link_points_to_is_replaced(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "old").touch()
    (tmp_path / "capture").symlink_to(tmp_path / "disk")
    with replacing_folder(tmp_path / "capture", lambda _: True) as made:
        (made / "new").touch()
    assert (tmp_path / "capture").is_symlink() and (tmp_path / "disk" / "new").exists()
    assert {path.name for path in tmp_path.iterdir()} == {"capture", "disk"}


def test_json_with_a_mark_of_its_encoding(tmp_path):
    (tmp_path / "t.json").write_text(json.dumps({"name": "Schüssel"}), encoding="utf-8-sig")
    assert read_json(tmp_path / "t.json") == {"name": "Schüssel"}

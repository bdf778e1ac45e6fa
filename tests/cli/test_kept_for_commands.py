"""Commands on a capture read what an earlier one has kept; their results do not depend on it."""

from __future__ import annotations

import json
import re
import shutil

import pytest
from support.helpers import fails, names, run, write_scene
from support.second_command import require_equal

import svu_mi as svu

pytestmark = pytest.mark.usefixtures("variant")  # svu selects a variant

SIZE, PLAIN = ("--resolution", 24), "--no-pictures"  # pages draw the maps that are compared
COMMANDS = {
    "entropy": (*SIZE, PLAIN, "-o", "entropy"),
    "recover": (*SIZE, PLAIN, "--steps", 5, "-o", "textures"),
    "guide": (*SIZE, PLAIN, "--candidates", 5, "--add", 1, "-o", "next"),
    "inpaint": ("--recovered", "textures", PLAIN, "-o", "filled"),
    "report": ("--recovered", "textures", "-o", "report.html"),
}  # fmt: skip

FOUND = re.compile(  # as the last lines
    r"\nWrote report\.html\n\d+ % of the surface area seen, mean entropy 0\.\d\d\. Roughness known "
    r"to ±0\.05 on .* of the surface area seen, metallic on .*, base colour on .* \(90 % intervals "
    r"of .*\)\.\n\Z"
)


@pytest.mark.slow
def test_all_results_are_equal_to_the_bit(shot, tmp_path, monkeypatch, capsys):
    capture, sides = tmp_path / "capture", (tmp_path / "without", tmp_path / "with")
    shutil.copytree(shot, capture, ignore=shutil.ignore_patterns("cache"))
    scene = json.loads((shot / "capture.json").read_text())["scene"]
    record = json.loads((capture / "capture.json").read_text())
    (capture / "capture.json").write_text(
        json.dumps({**record, "scene": str((shot / scene).resolve())})
    )
    for side, cache in zip(sides, ("--no-cache", "--cache"), strict=True):
        side.mkdir()
        monkeypatch.chdir(side)
        for name, words in COMMANDS.items():
            assert run(name, capture, *words, cache) == 0
            printed = "".join(capsys.readouterr())
            kept = name == "entropy" and cache == "--cache"
            assert ("Kept statistics in" in printed) == kept, (name, printed)
            assert ("Reading statistics from" in printed) == (cache == "--cache" and not kept)
        assert FOUND.search(printed)  # by report
        if cache == "--no-cache":
            assert not (capture / "cache").exists()
    assert require_equal(*sides) > 10
    guidance, pages = (
        [(side / path).read_text() for side in sides]
        for path in ("next/guidance.json", "report.html")
    )
    proposals = [json.loads(text)["proposals"] for text in guidance]
    assert proposals[0] == proposals[1]
    pictures = [re.findall("data:image/[^\"')]+", page) for page in pages]
    assert len(pictures[0]) > 10 and pictures[0] == pictures[1]


def test_nothing_is_kept_beside_a_scene(tmp_path):
    """The folder of a scene is the user's own."""
    path = write_scene(tmp_path)
    svu.render_capture(path, spp=1, folder=tmp_path / "images", views=3, resolution=(24, 24))
    (tmp_path / "images" / "capture.json").unlink()
    before = names(tmp_path), names(tmp_path / "images")
    words = ("--images", tmp_path / "images", "--resolution", 8, "--no-pictures")
    assert run("entropy", path, *words, "-o", tmp_path / "out") == 0
    after = names(tmp_path), names(tmp_path / "images")
    assert after == (sorted([*before[0], "out"]), before[1])
    record = {"format": "svu-capture", "scene": f"../{path.name}"}  # of the page on captures
    (tmp_path / "images" / "capture.json").write_text(json.dumps(record))
    assert run("entropy", tmp_path / "images", *words[2:], "-o", tmp_path / "out") == 0
    assert (tmp_path / "images" / "cache").is_dir()


def test_the_size_is_checked_before_any_work(shot, capsys):
    assert fails(capsys, "entropy", shot, "--cache-size", "some") == (
        "svu: --cache-size takes a size such as 4G or 800M, got 'some'."
    )

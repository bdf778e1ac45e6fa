"""Remedies in messages: the command that a message names works on the same input."""

from __future__ import annotations

import shlex
import shutil
from functools import cache

import pytest
from support.helpers import run, sensor_xml, write_scene

from svu_mi import scenes

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("variant")]

SIZE = "--resolution 16 --no-pictures"
# A command that fails | its remedy as printed | the command with the remedy.
ROWS = f"""
entrpy cap {SIZE} | did you mean entropy? | entropy cap {SIZE} -o new
entropy maps {SIZE} | give the capture it was computed from (cap). | entropy cap {SIZE} -o new
recover scene/shots {SIZE} | neither | entropy scene/scene.xml --images scene/shots {SIZE} -o new
entropy scene/scene.xml {SIZE} | --render to render | entropy scene/scene.xml --render --spp 1 {SIZE} -o new
entropy cap --render {SIZE} | omit --render | entropy cap {SIZE} -o new
entropy cap {SIZE} -o full | or --overwrite, which keeps | entropy cap {SIZE} -o full --overwrite
entropy cap --resolution 0 | takes one or two positive numbers | entropy cap {SIZE} -o new
entropy cap {SIZE} --known metal=0 | or metallic. | entropy cap {SIZE} --known metallic=0 -o new
entropy cap {SIZE} --known metallic | such as metallic=0 | entropy cap {SIZE} --known metallic=0 -o new
entropy cap {SIZE} --memory 4X | such as 4G | entropy cap {SIZE} --memory 4G -o new
entropy cap {SIZE} -m llvm_ad | omit -m, or use | entropy cap {SIZE} -o new
entropy cap {SIZE} -D window | -D takes KEY=VALUE | entropy cap {SIZE} -D light=window -o new
entropy less {SIZE} | --missing leave-out | entropy less {SIZE} --missing leave-out -o new
recover cap {SIZE} --steps 3 --resume | omit --resume | recover cap {SIZE} --steps 3 -o new
recover cap {SIZE} --epochs 1 | --epochs has no effect with --method sh; omit it. | recover cap {SIZE} --steps 3 -o new
recover cap {SIZE} --draws 2 --preset paper | omit one of them | recover cap {SIZE} --draws 2 --steps 3 -o new
export maps | svu recover | export textures -o new
report cap -o cap | such as report.html | report cap --resolution 16 -o report.html
report cap -o a.txt | such as report.html | report cap --resolution 16 -o report.html
report cap --recovered maps | maps: has no base_color.exr, roughness.exr, metallic.exr, so it is not a result of svu recover but of svu entropy; run svu recover on the same capture, and give its output folder. | report cap --recovered textures --resolution 16 -o report.html
report cap --recovered textures --resolution 8 | give --resolution 16 16 | report cap --recovered textures --resolution 16 16 -o report.html
""".strip().splitlines()  # noqa: E501


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Return a folder with a capture, one that lacks a photograph, results, and a scene."""
    folder = tmp_path_factory.mktemp("place")
    words = ("--views", 8, "--resolution", 40, 32, "--spp", 4, "-D", "light=window")
    assert run("render", scenes.path("vase"), *words, "-o", folder / "cap") == 0
    shutil.copytree(folder / "cap", folder / "less")
    (folder / "less" / "view_0007.exr").unlink()
    (folder / "full").mkdir()
    (folder / "full" / "notes.txt").write_text("mine")
    (folder / "scene").mkdir()
    scene = write_scene(folder / "scene", sensors=sensor_xml(4, 32, 32))
    scene.rename(folder / "scene" / "scene.xml")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for line in (f"entropy cap {SIZE} -o maps", f"recover cap {SIZE} --steps 3 -o textures",
                     "render scene/scene.xml --spp 1 -o scene/shots"):  # fmt: skip
            assert run(*shlex.split(line)) == 0
    (folder / "scene" / "shots" / "capture.json").unlink()
    return folder


@pytest.mark.filterwarnings("ignore:full. the older content is kept")
@pytest.mark.parametrize("row", ROWS)
def test_the_remedy_of_a_message_works(place, monkeypatch, capsys, row):
    monkeypatch.chdir(place)
    bad, message, good = (part.strip() for part in row.split(" | "))
    assert run(*shlex.split(bad)) == 2
    assert message in capsys.readouterr().err
    assert works(good)


@cache
def works(line):
    """Run a line that several messages lead to, once."""
    status = run(*shlex.split(line))
    shutil.rmtree("new", ignore_errors=True)
    return status == 0

"""From phone photographs to an asset: the lines of the page, with options that were printed."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from support.helpers import run
from support.phone import LIGHT, MILLIMETRES, RATIO, true_textures, write_phone_capture

import svu_mi as svu

pytestmark = pytest.mark.usefixtures("variant")  # svu selects a variant

SIDE = 64
# For a shorter test; the page is for 512 texels per side.
SMALLER = {
    "light": "--texels 300 --depths 256 6 --resolution 64 --no-pictures",
    "recover": f"--resolution {SIDE} --no-pictures", "report": f"--resolution {SIDE}",
}  # fmt: skip
LOST = 2.0  # dB that an unknown light may cost


@pytest.mark.slow
def test_the_lines_of_the_page_lead_from_photographs_to_an_asset(
    root, tmp_path, monkeypatch, capsys
):
    radiance = write_phone_capture(tmp_path)
    monkeypatch.chdir(tmp_path)
    page = (root / "notebooks" / "phone.md").read_text()
    lines = [line[8:] for line in page.splitlines() if line.startswith("    svu ")]
    assert [line.split()[0] for line in lines] == [
        "import", "import", "check", "light", "recover", "report", "export",
    ]  # fmt: skip
    said = []
    for line in lines:
        words = [*shlex.split(line), *SMALLER.get(line.split()[0], "").split()]
        assert run(*words) == 0
        said.append(" ".join(capsys.readouterr().out.split()))

    assert f"EXIF: exposures differ by {RATIO} x" in said[0]
    (scale,) = re.findall(r"import with (--mesh-scale \S+)\. ", said[0])
    assert float(scale.split()[1]) == 1 / MILLIMETRES and scale in lines[1]
    assert "mesh-scale" not in said[1] and "inside" not in said[1]
    assert "poses (fits)" in said[2] and "The capture fits its photographs" in said[2]
    assert "Using the estimated light in bare/light." in said[4]
    assert trimesh.load_scene("out/asset/asset.glb").geometry

    probe = f"--environment {root}/scenes/lights/{LIGHT}.exr --environment-scale {radiance}"
    assert run(*shlex.split(f"{lines[1].removesuffix('bare')} known {probe}")) == 0
    assert run(*f"recover known -o out/known {SMALLER['recover']}".split()) == 0
    mesh = svu.load_capture("bare", light="optional").mesh
    found, known = (accuracy(Path("out") / name, mesh) for name in ("textures", "known"))
    for name in known:
        assert found[name] > known[name] - LOST, (name, found, known)


def accuracy(folder: Path, mesh: object) -> dict[str, float]:
    """Return PSNR of texels that four photographs show; base colour after a factor per channel."""
    index, result = svu.texels(mesh, SIDE).index.numpy(), {}

    def read(name: str) -> np.ndarray:
        image = np.array(mi.Bitmap(str(folder / f"{name}.exr")), np.float32)
        return image.reshape(SIDE**2, -1)[index]

    seen = read("coverage")[:, 0] >= 4
    assert seen.mean() > 0.4
    for name, truth in true_textures(mesh, SIDE).items():
        values, wanted = read(name)[seen], truth[seen]
        if name == "base_color":
            values = values * (values * wanted).sum(axis=0) / (values**2).sum(axis=0)
        result[name] = float(-10 * np.log10(np.mean((values - wanted) ** 2)))
    return result

"""The first hour of somebody with a mesh, poses and pictures of other programs."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from hour import done, svu
from support.colmap import write_colmap

from svu_mi import read_source
from svu_mi.exr import read_exr, write_exr

FITS = "The capture fits its photographs, as far as can be determined."


@pytest.mark.slow
def test_a_capture_needs_no_light_to_look_at_its_poses(shots):
    """No map of the light: are the poses right? And then it is found."""
    said = done("import blender --mesh scan.ply -o dark", shots)
    assert said.out[-3:] == [
        "The capture has no light, which is found in its photographs: look at what svu light "
        "finds, or go on. If there is a map of the light that they were taken under, import the "
        "capture again with --environment.",
        "Wrote dark; look at it with: svu check dark",
        "Then find its light with: svu light dark",
    ]
    said = done("check dark -o out/dark", shots)
    assert any(line.startswith("poses (fits): Cameras and mesh fit") for line in said.out)
    assert (
        "light (unknown): The orientation of the light cannot be determined: the capture has none."
    ) in said.out
    assert said.out[-2] == FITS
    said = done("light dark --texels 100 --depths 64 4 -o dark/light", shots)
    assert any(line.startswith("Base colours are known up to a common factor") for line in said.out)
    said = done("entropy dark --resolution 32 -o out/dark_entropy", shots)
    assert "Using the light found before in dark/light." in said.out


@pytest.mark.slow
def test_pictures_of_8_bits_are_one_sentence(shots):
    said = done("import phone --mesh scan.ply --environment probe.exr -o phoned", shots)
    about = [line for line in said.out if "photographs" in line and "bits" in line]
    assert len(about) == 1
    assert about[0].startswith(
        "24 of 24 photographs, IMG_1.png first, are not HDR: of 8 bits, decoded as srgb, "
    )
    assert about[0].endswith(
        " clipped pixels count as at least so bright. Clipped highlights hide gloss: use HDR."
    )
    said = done("check phoned -o out/phoned", shots)
    assert any(line.split()[0].startswith("IMG_") for line in said.out if line.startswith(" IMG"))
    assert not [line for line in said.out if "view_" in line]


@pytest.mark.slow
def test_axes_are_wrong_and_the_command_that_mends_them_is_pasted(shots):
    up = "--mesh-up z --world-up y"
    done(f"import blender --mesh scan.ply {up} --environment probe.exr -o turned", shots)
    said = done("check turned -o out/turned", shots)
    assert any(line.startswith("poses (WRONG): ") for line in said.out)
    (advice,) = [line for line in said.out if line.startswith("Import it again with: ")]
    assert advice.startswith("Import it again with: svu import blender --environment probe.exr ")
    assert "--mesh scan.ply" in advice and "--fix mesh-" in advice and " -o turned" in advice
    done(advice.partition(": svu ")[2], shots)
    assert FITS in done("check turned -o out/turned", shots).out


@pytest.mark.slow
def test_photographs_of_a_phone_are_straightened(shots):
    """k1, k2, p1 and p2 in transforms.json, and no COLMAP model."""
    said = done("import blender/lens.json --mesh scan.ply --environment probe.exr -o flat", shots)
    assert (
        "24 of 24 photographs, IMG_1.exr first, are straightened, since their lenses are distorted;"
        " the focal length is kept, and borders are cut where nothing was seen."
    ) in said.out
    done("entropy flat --resolution 32 -o out/flat", shots)


@pytest.mark.slow
def test_textures_are_looked_at_beside_those_painted_in_blender(shots):
    """And a folder that holds no textures is said to be what it is."""
    done("entropy capture --resolution 64 -o out/entropy", shots)
    done("recover capture --resolution 64 -o out/textures --no-pictures", shots)
    assert svu("report capture --recovered out/entropy", shots).refusal == (
        "out/entropy: has no base_color.exr, roughness.exr, metallic.exr, so it is not a result of "
        "svu recover but of svu entropy; run svu recover on the same capture, and give what it "
        "writes."
    )
    line = "report capture --recovered out/textures --resolution 128"
    assert svu(line, shots).refusal == (
        "out/textures: the textures have 64 x 64 texels; omit --resolution, which is theirs."
    )
    said = done("compare out/textures scenes/vase -o out/compared", shots)
    assert said.out[-1].startswith("Of the surface that both show, ")
    done("export out/textures -o out/asset", shots)
    assert (shots / "out" / "asset" / "asset.glb").is_file()


@pytest.mark.slow
def test_a_model_of_colmap_is_found(shots):
    """In its usual place: svu import colmap, colmap/sparse or colmap/sparse/0."""
    source = read_source(shots / "blender")
    write_colmap(shots / "colmap", source)
    for number, place in enumerate(("colmap", "colmap/sparse", "colmap/sparse/0")):
        line = f"import {place} --mesh scan.ply --environment probe.exr -o colmap_{number}"
        assert done(line, shots).out[-1].startswith(f"Wrote colmap_{number}; look at it with: ")


@pytest.mark.slow
def test_gains_that_do_not_fit_are_named(shots):
    """All photographs twice as bright; and one of them half as bright again as the others."""
    line = "render scenes/vase/vase.xml -D light=window --views 24 --resolution 96 --spp 16"
    done(f"{line} -o around", shots)
    for name, gains in (("doubled", [2.0] * 24), ("one", [1.0] * 7 + [1.5] + [1.0] * 16)):
        shutil.copytree(shots / "around", shots / name)
        for number, gain in enumerate(gains):
            path = shots / name / f"view_{number:04d}.exr"
            planes = {c: plane * (1 if c == "A" else gain) for c, plane in read_exr(path).items()}
            write_exr(path, planes)
    too_bright = (
        r"\d\d % of the surface reflects more than all the light that reaches it: the photographs "
        r"are too bright for this light, by a factor of [12]\.\d or more; check their gain \(svu "
        r"import --exposures, or divide the photographs\) and the light's \(--environment-scale, "
        r"or scale in the scene\)\."
    )
    assert re.search(rf"^gain \(UNCLEAR\): {too_bright}$", lines("check doubled", shots), re.M)
    said = done("entropy doubled --resolution 64 --no-pictures -o out/doubled", shots)
    assert len(said.warnings) == 1 and re.fullmatch(too_bright, said.warnings[0]), said
    assert re.search(
        r"^gain \(UNCLEAR\): One photograph has another gain than the others: view_0007\.exr "
        r"\(x 1\.\d\d\); give the exposure of each photograph \(svu import --exposures, or "
        r"divide its pixels by it\), or leave it out\.$", lines("check one", shots), re.M,
    )  # fmt: skip


def lines(line: str, folder: Path) -> str:
    """Return what a line has printed, as one text."""
    return "\n".join(done(line, folder).out)

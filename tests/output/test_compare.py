"""What differs between two results: captures, recoveries, and anybody's textures."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from support.helpers import ball, fails, lettered, recovered_folder, run, write_known

import svu_mi as svu
from svu_mi import scenes
from svu_mi.capture.image_io import quantized, srgb
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.errors import CaptureError, OptionError
from svu_mi.output.compare.compare_page import write_comparison
from svu_mi.output.compare.differences import difference
from svu_mi.parameters import NAMES

pytestmark = pytest.mark.usefixtures("variant")  # svu chooses one
WIDTH, HEIGHT = 96, 64


@pytest.fixture(scope="module")
def recovered(tmp_path_factory):
    """A folder as of svu recover, of which the right half is unseen."""
    folder = tmp_path_factory.mktemp("recovered")
    recovered_folder(folder, lettered(WIDTH, HEIGHT))
    write_known(folder, WIDTH, HEIGHT)
    return folder


def painted(folder, recovered, change=0.0, scale=1):
    """Somebody's textures: 8-bit PNG with sRGB colours, rougher by ``change``, of another size."""
    folder.mkdir()
    textures = {name: read_exr(recovered / f"{name}.exr") for name in NAMES}
    color = np.stack([textures["base_color"][c] for c in "RGB"], axis=-1)
    rough = np.clip(textures["roughness"]["Y"] + change, 0, 1)
    for name, image in (("base_color", srgb(color)), ("roughness", rough),
                        ("metallic", textures["metallic"]["Y"])):  # fmt: skip
        large = np.kron(quantized(image), np.ones((scale, scale) + (1,) * (image.ndim - 2), "u1"))
        Image.fromarray(large).save(folder / f"{name}.png")
    return folder


def differ(first, second, **options):
    """Compare maps (32, 32, C) of a square without a mesh."""
    return difference(first, second, np.ones((32, 32)), **options)


def test_textures_of_others_are_compared(recovered, tmp_path, capsys):
    """8-bit colours are decoded, sizes differ, and what was never seen is left out."""
    theirs = painted(tmp_path / "theirs", recovered, change=0.1, scale=2)
    assert run("compare", recovered, theirs, "-o", tmp_path / "out") == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [
        f"Wrote {tmp_path / 'out' / 'compare.html'}",
        "Of the surface that both show, base colour differs by more than 0.05 on 0 %, roughness "
        "differs by more than 0.05 on 100 %, metallic differs by more than 0.05 on 0 %.",
    ]
    record = json.loads((tmp_path / "out" / "compare.json").read_text())
    figures = record["differences"]["roughness"]["all"]
    assert figures["mean"] == pytest.approx(0.1, abs=0.002)
    assert figures["psnr"] == pytest.approx(20, abs=0.2)
    assert record["resolution"] == [WIDTH, HEIGHT]
    assert record["seen_part"] == pytest.approx(0.5, abs=0.05)
    assert f"{theirs / 'base_color.png'}: 8 bits, decoded as sRGB." in record["notes"]
    assert f"{theirs}: assumed to use the same UVs." in record["notes"]
    written = read_exr(tmp_path / "out" / "difference_roughness.exr")
    compared = written["compared"] > 0
    assert compared.mean() == pytest.approx(0.375 * 0.7, abs=0.03)  # but for the poles
    np.testing.assert_allclose(written["Y"][compared], 0.1, atol=0.004)
    assert (written["Y"][~compared] == 0).all()
    colors = read_exr(tmp_path / "out" / "difference_base_color.exr")
    assert max(np.abs(colors[c]).max() for c in "RGB") < 0.01


def test_results_of_other_meshes_are_refused(recovered, tmp_path):
    other, turned = tmp_path / "other", tmp_path / "turned"
    recovered_folder(other, lettered(WIDTH, HEIGHT), uvs=ball().uvs * 0.5)
    with pytest.raises(CaptureError, match="belong to different meshes"):
        svu.compare(recovered, other)
    moved = 2 * ball().positions[:, [1, 2, 0]]  # the same object, elsewhere in its world
    recovered_folder(turned, lettered(WIDTH, HEIGHT), positions=moved)
    assert svu.compare(recovered, turned).differences["roughness"].figures["psnr"] == 100


def test_folders_without_anything_are_refused(recovered, tmp_path, capsys):
    line = fails(capsys, "compare", recovered, tmp_path, "-o", tmp_path / "out")
    assert line == (
        f"svu: {tmp_path}: contains neither a capture (capture.json), nor entropy.exr, nor "
        "textures (base_color, roughness, metallic as EXR or PNG); give another folder."
    )
    (tmp_path / "rough").mkdir()
    write_exr(tmp_path / "rough" / "roughness.exr", {"Y": np.zeros((8, 8))})
    (tmp_path / "metal").mkdir()
    write_exr(tmp_path / "metal" / "metallic.exr", {"Y": np.zeros((8, 8))})
    with pytest.raises(CaptureError, match="has roughness, and .* metallic: nothing to compare"):
        svu.compare(tmp_path / "rough", tmp_path / "metal")
    with pytest.raises(OptionError, match="b must be a str, a Path, a Capture, .* got 3"):
        svu.compare(recovered, 3)
    words = ("compare", recovered, recovered, "-o", tmp_path / "out")
    assert "--tolerance must be at least 0, got -1." in fails(capsys, *words, "--tolerance", -1)
    line = fails(capsys, *words, "--preset", "fast", "fast", "fast")
    assert line == "svu: --preset takes one preset, or two for A and B."
    line = fails(capsys, *words, "--resolution", 1)
    assert line == "svu: --resolution must be 2 to 16384 texels per side, got 1 x 1."


NUMBER = "compare(): tolerance must be a number of at least 0, got"
SIDES = "compare(): resolution must be 2 to 16384 texels per side, got"
ONE_OR_TWO = "compare(): preset must be the name of a preset, or two names for a and b, got"
UNKNOWN = "Unknown preset 'nope'; method 'angular' has default, fast, fixed, paper."


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"resolution": 0}, f"{SIDES} 0 x 0."), ({"resolution": -1}, f"{SIDES} -1 x -1."),
        ({"resolution": 200_000}, f"{SIDES} 200000 x 200000."),
        ({"resolution": 2.5}, "compare(): resolution must be a whole number or a tuple, got 2.5."),
        ({"resolution": (4, 4, 4)}, "compare(): resolution must have 2 values, got (4, 4, 4)."),
        ({"preset": ("default",)}, f"{ONE_OR_TWO} ('default',)."),
        ({"preset": 3}, "compare(): preset must be a str or a tuple, got 3."),
        ({"preset": ("fast", None)}, "compare(): preset[1] must be a str, got None."),
        ({"preset": "nope"}, UNKNOWN), ({"preset": ("fast", "nope")}, UNKNOWN),
        ({"tolerance": "x"}, "compare(): tolerance must be a number, got 'x'."),
        ({"tolerance": float("nan")}, f"{NUMBER} nan."),
        ({"tolerance": -1}, f"{NUMBER} -1."),
    ],
)  # fmt: skip
def test_bad_options_are_refused_before_anything_is_read(recovered, options, sentence):
    """Of folders too, where no preset is used."""
    with pytest.raises(OptionError) as refusal:
        svu.compare(recovered, "nowhere", **options)
    assert str(refusal.value) == sentence


@pytest.mark.slow
def test_entropies_of_other_meshes_are_refused_by_their_records(shot, vase, tmp_path):
    """A result of svu entropy has no mesh, but its record says which it was."""
    for name in "ab":
        assert run("entropy", shot, "-o", tmp_path / name, "--resolution", 32) == 0
    same = svu.compare(tmp_path / "a", tmp_path / "b")
    assert same.sentence() == (
        "Of the surface that both show, the entropy differs by +0.000 in the mean."
    )
    record = json.loads((tmp_path / "b" / "run.json").read_text())
    record["inputs"]["mesh"] = "0" * 32
    (tmp_path / "b" / "run.json").write_text(json.dumps(record))
    with pytest.raises(CaptureError, match="belong to different meshes"):
        svu.compare(tmp_path / "a", tmp_path / "b")
    with pytest.raises(CaptureError, match="belong to different meshes"):
        svu.compare(vase.estimate, tmp_path / "b")
    assert svu.compare(vase.estimate, tmp_path / "a").entropy is not None


def test_an_estimate_does_not_differ_from_itself(vase):
    comparison = svu.compare(vase.estimate, vase.estimate)
    assert comparison.sentence() == (
        "Of the surface that both show, base colour differs significantly on 0 %, roughness "
        "differs significantly on 0 %, metallic differs significantly on 0 %, the entropy differs "
        "by +0.000 in the mean."
    )
    assert (comparison.image("roughness")[comparison.seen] == 0).all()
    assert comparison.image("base_color").shape == (48, 64, 3)
    assert np.isnan(comparison.image("entropy")[~vase.texels.inside()]).all()
    with pytest.raises(OptionError, match="unknown map 'entropy_deviations'"):
        comparison.image("entropy_deviations")


@pytest.mark.slow
def test_two_presets_of_one_capture(shot, tmp_path, capsys):
    words = ("compare", shot, shot, "--preset", "default", "fast", "--resolution", 32)
    assert run(*words, "-o", tmp_path) == 0
    record = json.loads((tmp_path / "compare.json").read_text())
    assert [side["name"] for side in record["sides"]] == [f"{shot} (default)", f"{shot} (fast)"]
    assert record["differences"]["roughness"]["all"]["rms"] > 0.01


def test_what_is_certain():
    """A change of a part is; the same change of a single texel, or where little is known, not."""
    first, second = np.full((2, 32, 32, 1), 0.4, "f4")
    sd = np.full((32, 32, 1), 0.02)
    second[4:14, 4:14] += 0.06
    second[24, 24] += 0.06
    second[18:28, 4:14] += 0.06
    sd[18:28, 4:14] = 0.1
    certain = np.abs(differ(first, second, sd=sd).deviations[..., 0]) > 2
    assert certain[5:13, 6:12].all() and certain[6:12, 5:13].all()
    assert not certain[15:].any()
    assert not certain[:, 15:].any()


def test_noise_of_texels_is_not_certain():
    rng = np.random.default_rng(3391)
    first, second = rng.normal(0.5, 0.02, (2, 32, 32, 3)).astype("f4")
    one = differ(first, second, sd=np.full((32, 32, 3), 0.02 * 2**0.5), tolerance=0.05)
    assert one.figures["certain"] == 0
    assert one.figures["beyond"] > 0.1


def test_grey_and_coloured_maps_are_compared_by_their_mean():
    grey, colored = np.full((32, 32, 1), 0.5, "f4"), np.full((32, 32, 3), [0.3, 0.5, 0.7], "f4")
    assert differ(grey, colored).figures["rms"] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("width", [400, 1280])
def test_the_page_shows_it(recovered, tmp_path, browser, width):
    """With and without a mesh, in both widths."""
    theirs = painted(tmp_path / "theirs", recovered, change=0.1)
    for number, first in enumerate((recovered, theirs)):
        comparison = svu.compare(first, theirs)
        write_comparison(comparison, tmp_path / str(number))
        shown = browser.open(tmp_path / str(number) / "compare.html", width)
        assert shown.overflow == 0 and not shown.requests and not shown.complaints
        assert comparison.sentence() in shown.evaluate("document.body.innerText")
        shown.close()


@pytest.fixture(scope="module")
def changed(tmp_path_factory):
    """Two captures of two squares of copper: a quarter of them is rougher by .05 in the second."""
    folder = tmp_path_factory.mktemp("changed")
    for seed, (name, change) in enumerate({"before": 0.0, "after": 0.05, "again": 0.0}.items()):
        scene = scenes.copy("planes", folder / f"scene_{name}")
        rough = np.full((256, 256), 0.4, np.float32)
        rough[:, 192:] += change
        write_exr(scene.parent / "roughness.exr", {"Y": rough}, half=True)
        words = ("render", scene, "-D", "light=studio", "-D", "resolution=128", "--spp", 32)
        assert run(*words, "--seed", seed, "-o", folder / name) == 0
    return folder


@pytest.mark.slow
def test_a_change_of_one_part_is_shown_and_nothing_else(changed, tmp_path, capsys):
    """Must show: roughness .40 to .45, photographs with other noise; 82 % of the part is found.

    Of the rest none is (but within two texels of the part): of 13 000 texels there, the largest
    difference is 1.4 standard deviations, and 2 are asked for. A change to .42 is not certain, and
    nothing is shown.
    """
    before, after = changed / "before", changed / "after"
    assert run("compare", before, after, "--resolution", 128, "-o", tmp_path) == 0
    assert "roughness differs significantly on 2" in capsys.readouterr().out.splitlines()[-1]
    written = read_exr(tmp_path / "difference_roughness.exr")
    certain = (np.abs(written["deviations"]) > 2) & (written["compared"] > 0)
    column = (np.arange(128) + 0.5) / 128
    inside, elsewhere = column > 0.75, column < 0.75 - 2 / 128
    compared = written["compared"] > 0
    assert certain[:, inside].sum() > 0.75 * compared[:, inside].sum()
    assert compared[:, elsewhere].sum() > 10_000
    assert not certain[:, elsewhere].any()
    assert np.median(written["Y"][:, inside][compared[:, inside]]) == pytest.approx(0.045, abs=0.01)
    record = json.loads((tmp_path / "compare.json").read_text())
    for name in ("base_color", "metallic"):
        assert record["differences"][name]["all"]["certain"] == 0


@pytest.mark.slow
def test_two_sets_of_photographs_of_one_object_do_not_differ(changed):
    comparison = svu.compare(changed / "before", changed / "again", resolution=128)
    assert {one.figures["certain"] for one in comparison.differences.values()} == {0}

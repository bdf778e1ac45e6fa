"""``svu light``, and commands that estimate a missing light once and cache it."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.helpers import Said, fails, last_line, made_up_light, names, run, write_dark

import svu_mi as svu
from svu_mi import scenes
from svu_mi.calibration.light import resolve_light
from svu_mi.calibration.light.light_estimate import FoundGains
from svu_mi.capture.content_hash import capture_key, photographs_key
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.source import frame_of
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.errors import CaptureError, SvuWarning

pytestmark = pytest.mark.usefixtures("variant")  # svu selects a variant

# Light of few cells predicts held-out photographs badly, and commands warn of that.
COARSE = pytest.mark.filterwarnings("ignore:Unreliable")
SMALL = ("--texels", 100, "--depths", 64, 6, "--resolution", 48)
RANGE = r"Exposure gains range from 0\.82 \(view_\d+\.exr\) to 1\.22 \(view_\d+\.exr\)\."
FILES = ["light.exr", "light.json", "light.npz"]


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    """Also use small settings in other commands."""
    options = svu.LightOptions(texels=100, depths=((64, 6),), draws=2)
    monkeypatch.setattr(resolve_light, "OPTIONS", options)
    monkeypatch.setattr(resolve_light, "RESOLUTION", 48)


@pytest.fixture(scope="module")
def around(tmp_path_factory):
    """Vase with enough views that some texels are seen four times. Read only."""
    folder = tmp_path_factory.mktemp("around")
    words = ("render", scenes.path("vase"), "-D", "light=window", "--views", 24)
    assert run(*words, "--resolution", 48, "--spp", 16, "-o", folder) == 0
    return folder


@pytest.fixture
def dark(around, tmp_path):
    """Return the capture in a scene without a light."""
    return write_dark(around, tmp_path / "dark")


@pytest.fixture
def made_up(monkeypatch):
    """Replace the estimate of the light, and count its calls."""
    asked = []

    def estimate(capture, *_):
        asked.append(capture)
        return made_up_light()

    monkeypatch.setattr(resolve_light, "estimate_light", estimate)
    monkeypatch.setattr("svu_mi.calibration.light.estimate_light.estimate_light", estimate)
    return asked


def lit(folder: Path, given: Path | None = None, elsewhere: Path | None = None) -> Any:
    """Return the capture of a folder with a light, and the printed lines."""
    progress = Said()
    capture = svu.load_capture(folder, light="optional")
    light = given and svu.Light(path=given)
    lit = resolve_light.with_resolved_light(capture, light, elsewhere=elsewhere, progress=progress)
    return lit, "\n".join(progress.lines)


def entropy(capture: Path, out: Path, *words: object) -> int:
    return run("entropy", capture, "--resolution", 24, "--no-pictures", "-o", out, *words)


def record(folder: Path, name: str = "run.json") -> dict:
    return json.loads((folder / name).read_text())


@pytest.mark.slow
@pytest.mark.filterwarnings("always::svu_mi.errors.SvuWarning")
def test_recovering_with_a_wrong_light_warns(around, tmp_path, capsys):
    words = ("--resolution", 24, "--steps", 2, "--no-pictures", "-o", tmp_path)
    assert run("recover", around, "--light", scenes.FOLDER / "lights/overcast.exr", *words) == 0
    found = record(tmp_path)["result"]
    figure = f"R^2 {found['prediction']['r2']:.2f}"
    warning = f"Unreliable: held-out photographs are predicted with {figure}, "
    assert warning in capsys.readouterr().err and found["reliable"] is False


@pytest.mark.slow
def test_light_is_found_and_compared_with_that_of_the_capture(around, tmp_path, capsys):
    assert run("light", around, *SMALL, "-o", tmp_path / "a") == 0
    said = capsys.readouterr().out
    assert names(tmp_path / "a") == sorted([*FILES, "light.png"])
    assert "The light of the capture is used for comparison only." in said
    assert "Base colours are determined up to a factor per channel, " in said
    assert "Comparison with the light of the capture: correlation " in said
    against = record(tmp_path / "a", "light.json")["against"]
    assert against["correlation"] > 0.4  # .57, of 64 cells and 100 texels
    scaled = (*SMALL, "--light-scale", 2, "--no-pictures")
    assert run("light", around, *scaled, "-o", tmp_path / "b") == 0
    assert "Base colours are determined up to a factor per channel, " in capsys.readouterr().out
    assert names(tmp_path / "b") == FILES
    first, second = (svu.load_light(tmp_path / name) for name in "ab")  # deterministic
    np.testing.assert_allclose(second.radiance, 2 * first.radiance, rtol=1e-5)
    np.testing.assert_array_equal(second.cell_sd, first.cell_sd)
    assert (second.widening, second.misfit) == (first.widening, first.misfit)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--light-moves", "--light-fixed"), "--light-moves and --light-fixed exclude each other"),
        (("--light-scale", 2, "--mean-albedo", 0.3), "exclude each other; give one."),
        (("--mean-albedo", 1.5), "--mean-albedo: a base colour must be in [0.01, 1], got 1.5."),
        (("--grey-card", 0.5, 0.5, 0), "--grey-card: a base colour must be in [0.01, 1], got 0."),
        (("--grey-card", 0.5, 2, 0.2), "texture coordinates are in [0, 1], got 0.5 2."),
        (("--light-scale", 0), "--light-scale must be in [1e-06, 1e+06], got 0."),
        (("--depths", 10, 2), "depths must be (cells, rounds), ascending, of 64 to 4096 cells"),
    ],
)
def test_options_that_make_no_sense_are_refused(tmp_path, capsys, words, message):
    assert message in fails(capsys, "light", tmp_path, *words, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "moves", "background"),
    [
        ((), None, "none"),
        (("--light-moves",), True, "none"),
        (("--light-fixed",), False, "none"),
        (("--background", "distant"), None, "distant"),
    ],
)
def test_what_is_known_of_the_world_is_passed_on(
    around, tmp_path, monkeypatch, words, moves, background
):
    asked = []

    def estimate(capture, grid, options, progress):
        asked.append(options)
        return replace(made_up_light(), moves=bool(moves))

    monkeypatch.setattr("svu_mi.calibration.light.estimate_light.estimate_light", estimate)
    assert run("light", around, *SMALL, *words, "--no-pictures", "-o", tmp_path / "out") == 0
    assert [(one.moves, one.background) for one in asked] == [(moves, background)]
    used = record(tmp_path / "out", "light.json")["settings"]["used"]
    assert (used["moves"], used["background"]) == (moves, background)


@pytest.mark.slow
@COARSE
def test_it_is_found_once_and_reused(dark, tmp_path, capsys, made_up):
    assert entropy(dark, tmp_path / "first") == 0
    said = capsys.readouterr().out
    assert "The capture has no light; estimating it from the photographs." in said
    assert f"The light is cached in {dark / 'light'}." in said
    assert names(dark / "light") == FILES
    assert entropy(dark, tmp_path / "second") == 0
    assert f"Using the estimated light in {dark / 'light'}." in capsys.readouterr().out
    assert len(made_up) == 1
    first, second = (record(tmp_path / name) for name in ("first", "second"))
    assert first["inputs"]["light"] == second["inputs"]["light"]
    assert first["inputs"]["light"]["scale_interval"][0][0] == pytest.approx(0.72, abs=0.01)
    assert first["written"]["capture"] == second["written"]["capture"]


@pytest.mark.slow
@COARSE
def test_it_is_estimated_with_what_is_known(dark, tmp_path, capsys, monkeypatch):
    """A light that was estimated without the known value is not reused."""
    asked = []

    def estimate(capture, grid, options, *_):
        asked.append(dict(options.known))
        return made_up_light()

    monkeypatch.setattr(resolve_light, "estimate_light", estimate)
    lit(dark)
    assert entropy(dark, tmp_path / "a", "--known", "metallic=0", "roughness=0.5") == 0
    said = capsys.readouterr().out
    assert "not used, as it was estimated without --known metallic=0." in said
    lit(dark)  # more is known of the kept one
    recover = ("recover", dark, "--resolution", 16, "--steps", 2, "--no-pictures")
    assert run(*recover, "--known", "metallic=1", "-o", tmp_path / "b") == 0
    assert asked == [{}, {"metallic": 0.0}, {"metallic": 1.0}]
    relight = ("relight", dark, "--recovered", tmp_path / "b", "--known", "metallic=2")
    assert "--known: metallic must be in [0, 1], got 2." in fails(capsys, *relight)


@pytest.mark.few(1)
@pytest.mark.parametrize("spread", [0.2, 0.03])
def test_exposures_that_nobody_recorded_are_estimated_if_they_differ(dark, monkeypatch, spread):
    """--gains auto: only without recorded exposures and light; the light is kept accordingly."""
    asked, logarithm = [], np.zeros((24, 3))
    logarithm[::2], logarithm[1::2] = spread, -spread

    def estimate(capture, grid, options, *_):
        asked.append(options.gains)
        gains = FoundGains(logarithm, np.ones(24), np.zeros(24, bool)) if options.gains else None
        return replace(made_up_light(), gains=gains)

    monkeypatch.setattr(resolve_light, "estimate_light", estimate)
    record = json.loads((dark / "capture.json").read_text())
    del record["rendered"]
    (dark / "capture.json").write_text(json.dumps({**record, "exposure": [1.0] * 24}))
    recorded = svu.load_capture(dark, light="optional")
    assert recorded.exposures_known
    resolve_light.with_resolved_light(recorded, gains=None, progress=Said())
    assert asked == [False]
    shutil.rmtree(dark / "light")

    imported = {**record, "exposure": [], "import": {"format": "colmap"}}
    (dark / "capture.json").write_text(json.dumps(imported))
    capture = svu.load_capture(dark, light="optional")
    for attempt in range(2):
        progress = Said()
        even = resolve_light.with_resolved_light(capture, gains=None, progress=progress)
        differ = spread > 0.1
        assert any("not recorded" in line for line in progress.lines) == (attempt == 0)
        assert any(re.match(RANGE, x) for x in progress.lines) == differ
        wanted = capture.images[1] * np.exp(spread) if differ else capture.images[1]
        np.testing.assert_allclose(even.images[1], wanted, rtol=1e-5)
        assert [(dark / name).is_dir() for name in ("light", "light-gains")] == [not differ, differ]
    assert asked == [False, True]  # the second time, what was kept is used
    write_exr(dark / "even.exr", {"RGB": np.ones((8, 16, 3), np.float32)})
    resolve_light.with_resolved_light(
        capture, svu.Light(path=dark / "even.exr"), gains=None, progress=progress
    )
    assert "taken as equal under the given light" in progress.lines[-1]


@pytest.mark.slow
def test_it_is_found_again_in_other_photographs(dark, made_up):
    first, said = lit(dark)
    assert "The light is cached in " in said
    assert "Using the estimated light in " in lit(dark)[1]
    path = dark / "view_0003.exr"
    layers = read_exr(path)
    write_exr(path, {c: plane * (1 if c == "A" else 1.5) for c, plane in layers.items()})
    second, said = lit(dark)
    assert "not used, as it was estimated from other photographs." in said
    assert len(made_up) == 2 and photographs_key(first) != photographs_key(second)
    kept = record(dark / "light", "light.json")
    assert kept["written"]["capture"] == photographs_key(second)


def test_a_broken_one_is_said_and_found_again(dark, made_up):
    lit(dark)
    path = dark / "light" / "light.npz"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.warns(SvuWarning, match="the older content is kept as light.before"):
        assert "light.npz: File is not a zip file" in lit(dark)[1]
    assert len(made_up) == 2 and svu.load_light(dark / "light").texels == 99


@pytest.mark.slow
def test_light_is_cached_with_results_of_read_only_capture(dark, tmp_path, made_up):
    (dark / "light").write_text("in the way")
    place = tmp_path / "out" / "light"
    assert f"The light is cached in {place}." in lit(dark, elsewhere=place)[1]
    assert f"Using the estimated light in {place}." in lit(dark, elsewhere=place)[1]
    assert len(made_up) == 1
    assert "The light cannot be cached; the next command estimates it again." in lit(dark)[1]


def test_light_is_kept_in_the_capture_and_has_one_direction(dark, tmp_path, made_up, capsys):
    """The cameras are turned until +X, where the light is brightest, is up."""
    record = json.loads((dark / "capture.json").read_text())
    turned = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    for sensor in record["sensors"]:
        sensor["to_world"] = (turned @ sensor["to_world"]).tolist()
    (dark / "capture.json").write_text(json.dumps(record))
    estimated = lit(dark)[1]
    direction = re.search(r"Brightest direction, averaged .* elevation (8\d|90) .*", estimated)
    shutil.rmtree(dark / "light")
    assert run("light", dark, *SMALL, "--no-pictures", "-o", tmp_path / "out") == 0
    said = capsys.readouterr().out
    assert direction[0] in said and f"The light is cached in {dark / 'light'}." in said
    capture, said = lit(dark)
    assert f"Using the estimated light in {dark / 'light'}. Base colours are" in said
    assert run("light", dark, *SMALL, "--no-pictures", "-o", dark / "light") == 0
    assert "cached" not in capsys.readouterr().out
    assert lit(dark)[0].found_light is not None and len(made_up) == 3


def test_a_given_light_is_taken_instead(around, dark, tmp_path, made_up):
    svu.save_light(made_up_light(), tmp_path / "light", photographs="0" * 32)
    given, said = lit(around, tmp_path / "light")
    assert "using a light that was estimated from other photographs." in said
    assert given.found_light.texels == 99 and given.light_uncertainty.widening == 1.3
    as_map, said = lit(dark, tmp_path / "light" / "light.exr")
    assert as_map.found_light is None and as_map.light_uncertainty is None and not said
    own = lit(around)[0]
    assert own.environment.id() == "light" and own.found_light is None
    assert len({capture_key(one) for one in (given, as_map, own)}) == 3
    assert not made_up and not (around / "light").exists()
    with pytest.raises(CaptureError, match="give a folder written by svu light, or an env"):
        lit(around, tmp_path / "nothing")


def test_what_stops_the_search_is_one_line(dark, tmp_path, capsys, monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("svu_mi.calibration.light.estimate_light.estimate_light", stopped)
    assert run("light", dark, *SMALL, "-o", tmp_path / "out") == 130
    assert last_line(capsys) == "svu: interrupted; run the same command again"
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@COARSE
def test_from_photographs_without_a_light_to_textures(dark, tmp_path, capsys):
    """All later commands use the same light."""
    out = tmp_path / "textures"
    size = ("--resolution", 24)
    plain = (*size, "--no-pictures", "-o")
    assert run("entropy", dark, *plain, tmp_path / "entropy") == 0
    assert run("recover", dark, "--steps", 10, *plain, out) == 0
    assert run("report", dark, "--recovered", out, "-o", tmp_path / "page.html") == 0
    assert run("guide", dark, "--candidates", 6, "--add", 1, *plain, tmp_path / "next") == 0
    assert run("compare", dark, out, *size, "-o", tmp_path / "compared") == 0
    assert run("export", out, "-o", tmp_path / "asset") == 0
    said = capsys.readouterr()
    assert said.out.count("estimating it from the photographs") == 1
    assert said.out.count("Using the estimated light in ") == 4
    assert "come from another capture" not in said.err  # textures and report use the same light
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<h2>Estimated light</h2>" in page
    assert 'alt="Radiance of the light"' in page
    withheld = "No parameter is called known to ±0.05: the light or its brightness is estimated"
    assert said.out.count(withheld) == 4 and withheld in page and "as the light was est" in page
    assert 'class="parts"' not in page and "count as determined" not in page
    assert said.out.count("Base colours are determined up to a factor per channel") == 5
    runs = [record(tmp_path / name) for name in ("entropy", "textures", "next")]
    assert runs[0]["result"]["intervals"]["known_part"] == {}
    assert len({one["written"]["capture"] for one in runs}) == 1
    assert len({json.dumps(one["inputs"]["light"]) for one in runs}) == 1
    scene = svu.load_capture(out / "recovered.xml", dark)
    assert scene.environment.class_name() == "EnvironmentMapEmitter"


@pytest.mark.slow
@COARSE
def test_an_import_is_done_again_over_light_that_was_kept(around, tmp_path, made_up):
    """Import again: the light stays cached until the photographs change."""
    source = tmp_path / "source"
    shutil.copytree(around, source)
    capture = svu.load_capture(around)
    write_transforms(source / "transforms.json", [
        frame_of(sensor, source / name)
        for sensor, name in zip(capture.sensors, capture.names, strict=True)
    ])  # fmt: skip
    (source / "capture.json").unlink()
    capture.shape.write_ply(str(tmp_path / "mesh.ply"))
    line = ("import", source, "--mesh", tmp_path / "mesh.ply", "-o", tmp_path / "mine")
    assert run(*line) == 0
    assert entropy(tmp_path / "mine", tmp_path / "out") == 0
    assert run(*line) == 0
    assert entropy(tmp_path / "mine", tmp_path / "out") == 0
    assert len(made_up) == 1
    assert run(*line, "--shrink", 2) == 0
    assert entropy(tmp_path / "mine", tmp_path / "out") == 0
    assert len(made_up) == 2
    (tmp_path / "mine" / "light" / "notes.txt").write_text("mine")
    assert run(*line) == 0 and (tmp_path / "mine" / "light" / "notes.txt").is_file()

"""The report: what the estimate says, in one page that a browser shows as it should."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import posed, render_ball, write_scene
from support.unseen import blind

import svu_mi as svu
from svu_mi.capture.quantization import Saturation
from svu_mi.capture.scene import to_world
from svu_mi.capture.up_direction import up_direction
from svu_mi.cli.main import main
from svu_mi.core.arrays import evenly_spaced
from svu_mi.core.io.exr import write_exr
from svu_mi.output.interval_summary import Intervals, IntervalSummary
from svu_mi.output.object_views import front_and_right
from svu_mi.output.report import report, report_pictures, report_plots, summary_text
from svu_mi.output.report.turntable import Turntable
from svu_mi.posterior.prediction import HeldOutPrediction
from svu_mi.recovery.svbrdf_textures import uniform_textures

VIEWS = 5
NAME = '<img src=x onerror="y">.exr'
WARNING = "view_0001.exr: 4 pixels are NaN & <left> out."
SWITCHES = {"roughness": 0.3, "metallic": 0.0, "base_color": {"type": "rgb", "value": [0.6] * 3}}


@pytest.fixture(scope="module", autouse=True)
def _small():
    """Small pictures and few of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "SIDE", 48)
        patch.setattr(report, "FRAMES", 4)
        yield


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A ball from five sides; one photograph has NaN, one is black and left out."""
    light = {"type": "constant"}
    taken = render_ball(
        tmp_path_factory.mktemp("ball"), light, {"type": "principled", **SWITCHES},
        views=VIEWS, resolution=(40, 32), spp=16,
    )  # fmt: skip
    images = [np.array(image) for image in taken.images]
    images[1][10:12, 10:13] = np.nan
    saturated = np.zeros((32, 40), np.uint8)
    saturated[10:12, 12] = 7
    images[4] *= 0
    return replace(
        taken, images=tuple(images), names=(NAME, *taken.names[1:]), unusable=(0, 6, 0, 0, 0),
        clipped=(None, Saturation(saturated, np.ones(3, np.float32)), None, None, None),
        used=(True, True, True, True, False), exposures=(1.0, 1.0, 0.25, 1.0, 1.0),
        warnings=(WARNING,) * 14,
    )  # fmt: skip


@pytest.fixture(scope="module")
def estimate(capture):
    return svu.estimate(capture, svu.texels(capture.mesh, (48, 24)))


@pytest.fixture(scope="module")
def written(capture, estimate, tmp_path_factory):
    path = tmp_path_factory.mktemp("für <uns>") / "réport.html"
    steps = []
    svu.write_report(
        capture, estimate, path, title="Ball & <b>co</b>", settings={"scene": path, "spp": (1, 2)},
        progress=lambda done, total: steps.append((done, total)),
    )  # fmt: skip
    assert steps == [(k, 5) for k in range(1, 6)]
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    return path


@pytest.fixture(scope="module")
def text(written):
    return written.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def table(capture):
    """Four small frames all around."""
    return Turntable.around(capture, 4, side=48)


@pytest.fixture
def page(capture, estimate, tmp_path, monkeypatch):
    """Write a page without renders, changed in some way, and return its text."""

    def page(capture=capture, estimate=estimate, compared=0, **options):
        monkeypatch.setattr(report_pictures, "COMPARED", compared)
        svu.write_report(capture, estimate, tmp_path / "page.html", **options)
        return (tmp_path / "page.html").read_text(encoding="utf-8")

    return page


def section(text, name):
    return re.search(rf'<section id="{name}">(.*?)</section>', text, re.DOTALL)[1]


def test_unreliable_results_are_named_first(page, estimate):
    wrong = replace(estimate, prediction=HeldOutPrediction(0.12, 0.61))
    shown = page(estimate=wrong)
    assert "Unreliable: held-out photographs are predicted with R^2 0.12" in shown
    assert shown.index("Unreliable") < shown.index('<section id="photographs">')
    assert "held-out" not in page()


# --- In a browser -------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "dark"), [(1280, False), (400, True)])
def test_the_page_fits_and_loads_nothing(browser, written, width, dark):
    shown = browser.open(written, width, dark=dark)
    shown.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert shown.overflow == 0
    assert shown.requests == [] and shown.complaints == []
    pictures = shown.evaluate("[...document.images].map(i => i.complete && i.naturalWidth > 0)")
    assert len(pictures) > 30 and all(pictures)
    small = "[...document.querySelectorAll('p, td, figcaption, dd')].filter(e => e.innerText)"
    sizes = shown.evaluate(f"{small}.map(e => parseFloat(getComputedStyle(e).fontSize))")
    assert min(sizes) >= 13
    assert shown.evaluate("document.title").startswith("Ball & <b>co</b>")
    shown.close()


# --- What it says -------------------------------------------------------------------------


def test_numbers_are_those_of_the_estimate(text, estimate):
    seen = np.array(estimate.coverage) > 0
    mean = float(np.array(estimate.entropy)[seen].mean())
    assert re.search(rf"<dt>Mean entropy</dt><dd>{mean:.2f}<", text)
    assert re.search(r"<dt>Photographs used</dt><dd>4<small>of 5</small>", text)
    assert "All options of the preset" in text and "llvm_ad_rgb" in text and mi.__version__ in text
    assert "Gathering statistics" in section(text, "record")


class Banded(Intervals):
    """Half-widths of 0.04, 0.1 and 0.4 in bands of the ball, other ones for each parameter."""

    borders = {"roughness": (0.3, 0.6), "metallic": (0.5, 0.9), "base_color": (0.7, 0.7)}

    def __init__(self, estimate):
        super().__init__(estimate.posterior)
        self.v = np.array(estimate.texels.uv)[1]

    def half_width(self, name):
        first, second = self.borders[name]
        return np.where(self.v < first, 0.04, np.where(self.v < second, 0.1, 0.4))


def test_parts_are_of_the_area_and_sum_to_1(estimate):
    """Texels of a lat-long chart are small near its poles."""
    banded = Banded(estimate)
    area = np.sin(np.pi * banded.v) * (np.array(estimate.coverage) > 0)
    for name, (first, second) in banded.borders.items():
        parts = summary_text.WidthShares.of(estimate, banded, name)
        below = [area[banded.v < border].sum() / area.sum() for border in (first, second)]
        assert parts.settled == pytest.approx(below[0], abs=0.02)
        assert parts.roughly == pytest.approx(below[1] - below[0], abs=0.02)
        assert parts.settled + parts.roughly + parts.wide == pytest.approx(1)
    seen = IntervalSummary.of(estimate, banded).seen_part
    everywhere = np.sin(np.pi * banded.v)
    assert seen == pytest.approx(area.sum() / everywhere.sum(), abs=0.02) and seen < 1


def test_all_of_the_surface_is_exactly_all(estimate):
    """Else it would be called over 99 %, and a page would miss that nothing is seen."""
    for count in range(60, 160):
        footprint = mi.Float(np.array(estimate.texels.footprint)[:count])
        posterior = SimpleNamespace(axes={}, count=count)
        texels = SimpleNamespace(footprint=footprint, resolution=(count, 1))
        some = SimpleNamespace(texels=texels, posterior=posterior, observed=None)
        for seen in (True, False):
            some.coverage, some.entropy = np.full(count, int(seen)), np.zeros(count)
            assert IntervalSummary.of(some).seen_part == seen
        some.coverage = np.ones(count)
        for width in (0.05, 0.15, 0.16):
            half = np.full(count, width, np.float32)
            posterior.half_width = lambda *_, half=half: half
            parts = summary_text.WidthShares.of(some, Intervals(posterior), "roughness")
            where = (width == 0.05, width == 0.15, width == 0.16)
            assert (parts.settled, parts.roughly, parts.wide) == where


def test_known_parameters_are_listed_by_intervals(estimate, page, monkeypatch):
    banded, seen = Banded(estimate), np.array(estimate.coverage) > 0
    monkeypatch.setattr(report, "sampled_intervals", lambda *_: banded)
    text = page()
    area = np.array(estimate.texels.footprint, np.float64)[seen] ** 2
    below = [area[banded.v[seen] < v].sum() / area.sum() for v in (0.3, 0.5, 0.7)]
    told = [f"{100 * part:.0f}\u202f%" for part in below]
    assert len(set(told)) == 3
    lead = re.sub("<[^>]*>", "", re.search('<p class="lead">(.*?)</p>', text)[1])
    assert lead.startswith(
        f"4 photographs determine roughness on {told[0]}, metallic on {told[1]} and base colour on "
        f"{told[2]} of the visible surface, and all of them on {told[0]}."
    )
    assert text.count('<div class="parts"') == 3
    assert f"{told[1]} determined; median ±0." in text


def test_nothing_is_settled_by_its_entropy(capture, estimate, table, monkeypatch):
    """Whatever the entropy is, the same is said of what is settled."""
    intervals, told = Intervals(estimate.posterior), []
    for entropy in (0, 1):
        values = np.full(estimate.texels.count, entropy, np.float32)
        monkeypatch.setattr(report, "entropies", lambda _, values=values: values)
        known = IntervalSummary.of(estimate, intervals)
        summary = report._summary(capture, estimate, intervals, known, table)
        told.append((summary["settled"], summary["all_settled"]))
    assert told[0] == told[1] and len(told[0][0]) == 3


def test_points_are_shown_with_their_intervals(estimate, table):
    (low, high) = (np.array(end) for end in estimate.posterior.interval("roughness"))
    for example in report_plots.example_texels(table, estimate, [None] * 4):
        column, row = map(int, re.search(r"column (\d+), row (\d+)", example["sentence"]).groups())
        texel = list(estimate.texels.index.numpy()).index(row * 48 + column)
        told = {name: interval for name, _, interval in example["plots"]}
        assert told["roughness"] == f"{low[texel]:.2f} to {high[texel]:.2f}"
        assert re.fullmatch(r"R [\d.]+ to [\d.]+, G .*, B .*", told["base colour"])


def test_points_are_on_different_sides(estimate, table):
    frames = list(range(4))
    examples = list(report_plots.example_texels(table, estimate, frames))
    assert len({example["picture"] for example in examples}) == 3


def test_the_title_is_the_object(capture, page):
    assert "<h1>ball</h1>" in page(capture)


def test_names_and_warnings_are_escaped(text):
    assert NAME not in text and WARNING not in text
    assert "&lt;img src=x onerror=" in section(text, "photographs")
    warnings = section(text, "skipped")
    assert warnings.count("&amp; &lt;left&gt; out.") == 14 and "2 more" in warnings


def test_photographs_say_what_is_wrong_with_them(text):
    photographs = section(text, "photographs")
    assert (
        "2 saturated pixels, 4 unusable pixels" in photographs and "exposure × 0.25" in photographs
    )
    left_out = photographs[photographs.index("Not used: 1") :]
    assert "entirely black" in left_out and "view_0004.exr" in left_out


def test_neither_options_nor_warnings_name_a_folder(capture, page, tmp_path, text, written):
    assert str(written.parent) not in text and written.name in section(text, "record")
    secret = tmp_path / "client = no 7"
    other = tmp_path / "textures"
    told = replace(capture, source=secret, warnings=(
        f"{secret / 'a.png'}: an 8-bit image.", f"{other}: these come from another than {secret}."
    ))  # fmt: skip
    given = {
        "recovered": other,
        "define": (f"map={secret / 'sky.exr'}", "spp=4", "a="),
        "title": "now/then",
    }
    text = page(told, settings=given)
    assert str(tmp_path) not in text
    assert ">a.png: an 8-bit image." in text
    assert ">textures: these come from another than client = no 7." in text
    assert "map=sky.exr, spp=4, a=" in text and "now/then" in text


def test_all_that_is_skipped_is_said_in_sentences(estimate):
    every = SimpleNamespace(**vars(estimate))
    for number in (1, 2):
        every.skipped = dict.fromkeys(estimate.skipped, number)
        lines = summary_text.skipped_sentences(every)
        assert len(lines) == len(estimate.skipped) >= 9
        assert not any(line.startswith(reason) for reason in estimate.skipped for line in lines)
        assert all(line.endswith(".") for line in lines)
    every.skipped = {**dict.fromkeys(estimate.skipped, 0), "new reason": 3}
    assert summary_text.skipped_sentences(every) == ["new reason: 3."]


def test_what_faces_down_is_said_to(estimate):
    normals = np.array(estimate.texels.normal)
    up = np.array([0.0, 1.0, 0.0])
    assert summary_text.facing_direction(estimate, normals[1] < -0.3, up) == "downwards"
    assert summary_text.facing_direction(estimate, normals[1] > 0.3, up) == "upwards"
    assert summary_text.facing_direction(estimate, normals[0] > 0, up) is None
    assert summary_text.facing_direction(estimate, normals[0] > 2, up) is None  # no texel


# --- The turntable ------------------------------------------------------------------------


def test_a_ring_is_where_its_texel_is(capture, estimate):
    """One white texel on a black ball, near its equator."""
    table = Turntable.around(capture, 3, side=96)
    uv = np.array(estimate.texels.uv)
    best = table.find(estimate.texels, np.flatnonzero(abs(uv[1] - 0.45) < 0.05)[::9])
    texel, number, x, y = best
    values = np.zeros((estimate.texels.count, 3), np.float32)
    values[texel] = 1
    frame = table.frame(estimate.texels.to_image(values), number)
    bright = np.argwhere(frame[..., 0] > 0.5 * frame[..., 0].max())
    place = (bright.mean(axis=0) + 0.5) / frame.shape[:2]
    np.testing.assert_allclose(place, (y, x), atol=0.03)
    assert table.find(estimate.texels, np.array([texel])) == best


def test_up_is_where_cameras_have_it(capture):
    to_z = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    turned = posed(capture, *(to_z @ to_world(sensor) for sensor in capture.sensors))
    np.testing.assert_array_equal(up_direction(capture), [0, 1, 0])
    np.testing.assert_array_equal(up_direction(turned), [0, 0, 1])
    heights = [to_world(s)[2, 3] for s in Turntable.around(turned, 4, side=16).sensors]
    assert np.ptp(heights) < 1e-4 and min(heights) > 0.5
    candidates = svu.Candidates.around(turned, 9, lowest=0.2)
    assert min(to_world(sensor)[2, 3] for sensor in candidates.sensors) > 0.1


@pytest.mark.parametrize("unit", [1e-3, 1, 1e3])
def test_the_front_is_the_same_in_any_unit(capture, unit):
    """Also if the first photograph is from above, and so does not say where it is."""
    above = mi.ScalarTransform4f().look_at([0, 4 * unit, 0], [0, 0, 0], [0, 0, 1])
    poses = [np.array(above.matrix), *map(to_world, capture.sensors[1:])]
    for pose in poses[1:]:
        pose[:3, 3] *= unit
    frame = front_and_right(posed(capture, *poses), np.zeros(3), np.array([0.0, 1, 0]))
    np.testing.assert_allclose(frame, [[0, 0, 1], [1, 0, 0]], atol=1e-6)


def test_frames_are_free_of_their_background(table):
    """What was mixed with white at the silhouette would shine on a dark page."""
    frame = table.frame(np.full((24, 48, 3), 0.1, np.float32), 0)
    alpha = frame[..., 3]
    assert (alpha == 0).any() and (alpha == 1).mean() > 0.5
    edge = (alpha > 0.3) & (alpha < 1)
    assert edge.any() and np.quantile(frame[edge][:, :3], 0.95) < 0.2


def test_a_texel_that_no_frame_shows_has_no_ring(estimate, table):
    """From a little above, nothing shows the ball's lowest part."""
    low = np.flatnonzero(np.array(estimate.texels.normal)[1] < -0.97)
    assert len(low) and table.find(estimate.texels, low) is None
    high = np.flatnonzero(np.array(estimate.texels.normal)[1] > 0.97)
    assert table.find(estimate.texels, high) is not None


# --- Few views, many, and other methods ---------------------------------------------------


def test_nothing_seen_is_said(capture, estimate, page):
    few = replace(capture, used=(False,) * VIEWS, warnings=())
    text = page(few, blind(estimate))
    assert "No point of the surface is visible" in text and "No photograph was used" in text
    assert "There is nothing to compare" in text and "Not used: 5" in text
    assert "determine" not in text.lower() and 'class="bars"' not in text
    assert "nan" not in re.sub(r"data:image/[^\"]*", "", text).lower()


def test_one_view_of_the_method_as_printed(capture, estimate, page):
    one = replace(capture, used=(True,) + (False,) * (VIEWS - 1), masks=(None,) * VIEWS)
    text = page(one, svu.estimate(one, estimate.texels, "spectrum", "paper"))
    assert "1 photograph determines roughness on" in text and "It does not show" in text
    assert "specular consist of whole cells of the grid, up to 0.14 wide" in text
    assert "Most probable specular" in text and "base colour" not in section(text, "maps")
    assert "--recovered FOLDER" in section(text, "errors")


def test_channels_have_lines_of_their_own(capture, estimate):
    switches = svu.preset("default", method="angular", channels="joint")
    known = svu.estimate(capture, estimate.texels, preset=switches, known={"metallic": 0.0})
    drawn = dict(report_plots.marginal_plots(known))
    assert list(drawn) == ["roughness", "base colour"]
    assert {style for style, _, _ in drawn["base colour"].lines} >= {"red", "green", "blue"}
    assert len(drawn["roughness"].heights) == 8 and not len(drawn["base colour"].heights)
    assert report_pictures.most_probable_textures(known).resolution == (48, 24)
    assert "metallic = 0" in " ".join(summary_text.skipped_sentences(known))


def test_many_photographs_are_thinned_out(capture, estimate):
    many = SimpleNamespace(
        **vars(capture) | {name: getattr(capture, name) * 40
                           for name in ("sensors", "images", "masks", "names", "unusable", "used",
                                        "clipped", "exposures")}
    )  # fmt: skip
    many.count = len(many.sensors)
    shown, left_out = report_pictures.thumbnails(many, estimate)
    assert (len(shown), len(left_out)) == (60, 12)
    assert sum(thumbnail["first"] for thumbnail in shown) == 12
    assert evenly_spaced(200, 5).tolist() == [0, 50, 100, 149, 199]


def test_errors_separate_good_textures_from_bad(capture, estimate, monkeypatch):
    monkeypatch.setattr(report_pictures, "COMPARED", 2)
    best = report_pictures.most_probable_textures(estimate)
    good = report_pictures.render_errors(capture, best, grey=True)
    bad = report_pictures.render_errors(
        capture, uniform_textures(estimate.texels, 0.02), grey=False
    )
    assert [name for name, _ in good["rows"]] == [capture.names[0], capture.names[3]]
    assert good["views"] == 4 and len(good["shown"]) == 2
    percent = [float(errors["mean"].split("\u202f")[0]) for errors in (good, bad)]
    assert percent[0] < 5 < 20 < percent[1]


@pytest.mark.slow
def test_recovered_textures_of_any_size_are_shown(capture, page):
    text = page(textures=uniform_textures(svu.texels(capture.mesh, 16), 0.4), compared=1)
    recovered = section(text, "recovered")
    for name in ("base colour", "roughness", "metallic"):
        assert f"Recovered {name}." in recovered
    assert "with the recovered textures" in section(text, "errors")
    assert "in grey" not in section(text, "errors")


# --- The command --------------------------------------------------------------------------


@pytest.fixture
def scene(tmp_path, variant):
    """A scene folder with photographs of grey, and a mesh without UVs."""
    folder = tmp_path / "Wäsche & co"
    folder.mkdir()
    path = write_scene(folder, uvs=None)
    (folder / "images").mkdir()
    for view in range(3):
        grey = np.full((24, 24, 3), 0.2, np.float32)
        write_exr(folder / "images" / f"view_{view:04d}.exr", {"RGB": grey})
    yield path
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Warn)


@pytest.mark.filterwarnings("default::svu_mi.errors.SvuWarning")
def test_the_command_writes_a_page(scene, tmp_path, capsys):
    page = tmp_path / "new" / "page.html"
    words = ["report", str(scene), "-o", str(page), "--resolution", "16", "-t", "2"]
    page.parent.mkdir()
    page.write_text("mine")
    assert main(words) == 2 and "--overwrite, which keeps this" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0
    said = capsys.readouterr().err
    assert "no UVs" in said and "the older content is kept as page.html.before" in said
    text = page.read_text(encoding="utf-8")
    assert "laid out" in section(text, "skipped")  # the warning of the mesh
    assert page.with_name("page.html.before").read_text() == "mine"
    page.unlink()
    assert main([*words, "-o", str(tmp_path)]) == 2
    assert "is a folder; -o takes a file" in capsys.readouterr().err
    before = scene.read_bytes()
    for name in (scene, tmp_path / "new" / "page"):
        assert main([*words, "-o", str(name)]) == 2
        assert capsys.readouterr().err == (
            f"svu: -o takes a file name that ends in .html, such as report.html; got {name}.\n"
        )
    assert scene.read_bytes() == before
    assert main([*words, "--recovered", str(tmp_path / "none")]) == 2
    assert "none: no such folder" in capsys.readouterr().err and not page.exists()

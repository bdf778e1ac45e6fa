"""Files: EXR read back by OpenEXR itself, maps, overview, run.json, and what a failure leaves."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from svu_mi import exr
from svu_mi.capture import mesh as meshes
from svu_mi.capture.poses import sphere_sensors
from svu_mi.errors import CaptureError, OutputError, ShapeError
from svu_mi.exr import read_attributes, read_exr, write_exr
from svu_mi.files import replacing
from svu_mi.options import preset
from svu_mi.output import (
    environment_record,
    prepare_folder,
    views,
    write_maps,
    write_outputs,
    write_overview,
)
from svu_mi.output.manifest import write_manifest
from svu_mi.posterior import ParameterGrid
from svu_mi.surface import texels

RNG_SEED = 717209344


def stored(path: Path) -> dict[str, np.ndarray]:
    """What OpenEXR says is in a file, channel by channel, in the stored type."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: np.array(channel.pixels) for name, channel in file.channels().items()}


def color_image() -> np.ndarray:
    return np.random.default_rng(RNG_SEED).normal(size=(5, 7, 3)).astype(np.float32)


# --- EXR ----------------------------------------------------------------------------------

LAYOUTS = {
    "slice": lambda rgb: rgb[..., 1],
    "flip": lambda rgb: rgb[::-1, :, 0],
    "mirror": lambda rgb: rgb[:, ::-1, 2],
    "transpose": lambda rgb: rgb[..., 0].T,
    "fortran": lambda rgb: np.asfortranarray(rgb[..., 0]),
    "stride": lambda rgb: rgb[::2, ::3, 0],
    "one channel": lambda rgb: rgb[..., :1],
    "float64": lambda rgb: rgb[..., 0].astype(np.float64),
    "big endian": lambda rgb: rgb[..., 0].astype(">f4"),
    "integers": lambda rgb: (rgb[..., 0] * 100).astype(np.int64),
    "bool": lambda rgb: rgb[..., 0] > 0,
    "tensor": lambda rgb: mi.TensorXf(np.ascontiguousarray(rgb[..., 0])),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_any_memory_layout_is_stored_as_it_reads(tmp_path, layout):
    image = LAYOUTS[layout](color_image())
    write_exr(tmp_path / "a.exr", {"Y": image})
    expected = np.squeeze(np.array(image)).astype(np.float32)
    np.testing.assert_array_equal(stored(tmp_path / "a.exr")["Y"], expected)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")["Y"], expected)


def test_grouped_channels_are_stored_one_by_one(tmp_path):
    rgb = color_image()
    write_exr(tmp_path / "a.exr", {"RGB": rgb[::-1], "base.RGBA": np.dstack([rgb, rgb[..., :1]])})
    found = stored(tmp_path / "a.exr")
    assert sorted(found) == ["B", "G", "R", "base.A", "base.B", "base.G", "base.R"]
    np.testing.assert_array_equal(found["G"], rgb[::-1, :, 1])
    np.testing.assert_array_equal(found["base.A"], rgb[..., 0])


def test_mitsuba_reads_what_was_written(tmp_path):
    rgb = color_image()
    write_exr(tmp_path / "a.exr", {"RGB": rgb})
    np.testing.assert_array_equal(np.array(mi.Bitmap(str(tmp_path / "a.exr"))), rgb)


def test_half_floats_on_request(tmp_path):
    image = color_image()[..., 0]
    write_exr(tmp_path / "a.exr", {"Y": image}, half=True)
    assert stored(tmp_path / "a.exr")["Y"].dtype == np.float16
    assert read_exr(tmp_path / "a.exr")["Y"].dtype == np.float32
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")["Y"], image.astype(np.float16))
    with pytest.raises(OutputError, match="too large for float16"):
        write_exr(tmp_path / "a.exr", {"Y": image + 1e5}, half=True)


def test_attributes_come_back(tmp_path):
    given = {"svu:config": '{"a": [1]}', "svu:views": np.int64(24), "svu:sigma": 0.5}
    write_exr(tmp_path / "a.exr", {"Y": np.zeros((2, 3))}, given)
    found = read_attributes(tmp_path / "a.exr")
    assert {name: found[name] for name in given} == given


@pytest.mark.parametrize(
    ("channels", "error", "sentence"),
    [
        ({}, ShapeError, "got none"),
        ({"Y": np.zeros(4)}, ShapeError, r"channel Y must be \(H, W\)"),
        ({"RGB": np.zeros((4, 4))}, ShapeError, r"channel RGB must be \(H, W, 3\)"),
        ({"Y": np.zeros((4, 4, 2))}, ShapeError, r"got \(4, 4, 2\)"),
        ({"Y": np.zeros((0, 4))}, ShapeError, "one size"),
        ({"R": np.zeros((2, 2)), "G": np.zeros((2, 3))}, ShapeError, r"R \(2, 2\), G \(2, 3\)"),
        ({"Y": np.full((2, 2), np.nan)}, OutputError, "channel Y has 4 values that are NaN"),
        ({"Y": np.full((2, 2), np.inf)}, OutputError, "infinite"),
        ({"Y": np.full((2, 2), 1e300)}, OutputError, "too large"),
        ({"Y": np.zeros((2, 2), complex)}, OutputError, "complex128"),
        ({"Y": np.full((2, 2), "a")}, OutputError, "expected real numbers"),
    ],
)
def test_what_is_no_image_is_refused_before_a_file_exists(tmp_path, channels, error, sentence):
    with pytest.raises(error, match=sentence):
        write_exr(tmp_path / "a.exr", channels)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("value", "sentence"), [([1], "a list"), (2**40, "32 bits"), (None, "NoneType")]
)
def test_attributes_an_exr_cannot_hold_are_refused(tmp_path, value, sentence):
    with pytest.raises(OutputError, match=sentence):
        write_exr(tmp_path / "a.exr", {"Y": np.zeros((2, 2))}, {"svu:x": value})


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    """A file whose pixels come back changed is not kept."""
    path = tmp_path / "a.exr"
    write_exr(path, {"Y": np.ones((2, 2))})
    before = path.read_bytes()
    monkeypatch.setattr(exr, "_read_channels", lambda _: {"Y": np.zeros((2, 2), np.float32)})
    with pytest.raises(OutputError, match="channel Y did not survive"):
        write_exr(path, {"Y": np.full((2, 2), 2.0)})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_replacing_keeps_the_old_file_when_the_block_raises(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), replacing(path) as temporary:
        temporary.write_text("half a fi")
        _ = 1 / 0
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with replacing(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


def test_places_that_cannot_be_written_are_named(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.exr").mkdir()
    for place, sentence in (
        ("missing/a.exr", "there is no folder"),
        ("file/a.exr", "is not a folder"),
        ("folder.exr", "is a folder"),
        ("x" * 300 + ".exr", "too long"),
    ):
        with pytest.raises(OutputError, match=sentence):
            write_exr(tmp_path / place, {"Y": np.zeros((2, 2))})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.exr"]


def test_reading_says_what_is_wrong_and_nothing_else(tmp_path, capfd):
    """OpenEXR's own lines on stdout and stderr are kept away: our sentence is the only one."""
    # Compressible: raw pixels have no checksum, and a change in them cannot be noticed.
    write_exr(tmp_path / "good.exr", {"Y": np.outer(np.arange(64), np.arange(48))})
    data = (tmp_path / "good.exr").read_bytes()
    broken = bytearray(data)
    broken[len(data) // 2 : len(data) // 2 + 64] = bytes(64)
    (tmp_path / "folder.exr").mkdir()
    for name, content, sentence in (
        ("missing.exr", None, "no such file"),
        ("folder.exr", None, "a folder"),
        ("empty.exr", b"", "empty"),
        ("png.exr", b"\x89PNG\r\n", "not an EXR"),
        ("magic.exr", data[:4], "damaged"),
        ("header.exr", data[:200], "damaged"),
        ("half.exr", data[: len(data) // 2], "damaged"),
        ("cut.exr", data[:-1], "damaged"),
        ("broken.exr", bytes(broken), "damaged"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(CaptureError, match=sentence) as caught:
            read_exr(tmp_path / name)
        assert name in str(caught.value) and "\n" not in str(caught.value)
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


def test_other_programs_files_are_read(tmp_path):
    """Half floats, integers, several parts (the first counts), NaN."""
    y = np.array([[1, np.nan], [3, 4]], np.float16)
    parts = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"Y": y}, "first"),
        OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"Z": y}, "second"),
    ]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    np.testing.assert_array_equal(read_exr(tmp_path / "parts.exr")["Y"], y.astype(np.float32))
    id_map = np.array([[1, 2, 70000]], np.uint32)
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"id": id_map}).write(str(tmp_path / "id.exr"))
    np.testing.assert_array_equal(read_exr(tmp_path / "id.exr")["id"], id_map)


# --- A capture and an estimate of a dome --------------------------------------------------


@dataclasses.dataclass(frozen=True)
class FakePosterior:
    """Marginals and intervals as given; the shape of ``svu_mi.posterior.Posterior``."""

    rough: np.ndarray
    specular: np.ndarray
    grid: ParameterGrid = ParameterGrid(roughness=4, specular=5, spacing="uniform")

    @property
    def axes(self):
        return self.grid.axes

    @property
    def prior(self):
        return np.full(self.grid.shape, 1 / np.prod(self.grid.shape))

    def marginal(self, name, chosen):
        return mi.TensorXf((self.rough if name == "roughness" else self.specular)[chosen])

    def interval(self, name, _, chosen):
        """Roughness is known to 0.04 where it is most probably 0, Ks to 0.25 in one channel."""
        known = self.rough.argmax(axis=1) == 0
        if name == "roughness":
            width = np.where(known, 0.08, 1)[chosen]
            return mi.TensorXf(0.0 * width), mi.TensorXf(width)
        ends = np.tile([[[0.0, 0.1, 0.0]], [[0.0, 0.6, 0.0]]], (1, len(chosen), 1))
        return mi.TensorXf(ends[0]), mi.TensorXf(ends[1])


def dome() -> mi.Mesh:
    """A bulging sheet over the middle of the unit square of its UVs."""
    n = 13
    u, v = np.meshgrid(np.linspace(0.2, 0.8, n), np.linspace(0.1, 0.7, n))
    u, v = u.ravel(), v.ravel()
    x, y = 4 * (u - 0.5), 4 * (v - 0.4)
    position = np.stack([x, y, 1 - (x**2 + y**2) / 3], axis=1)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + n], 1),
         np.stack([corner + 1, corner + n + 1, corner + n], 1)]
    )  # fmt: skip
    return meshes.make("dome", meshes.MeshArrays(position, faces, None, np.stack([u, v], 1)))


@pytest.fixture(scope="module")
def capture():
    mesh = dome()
    rng = np.random.default_rng(RNG_SEED)
    sensors = sphere_sensors(mesh, 4, (40, 30))
    images = [rng.random((30, 40, 3)).astype(np.float32) for _ in sensors]
    images[0][3, 4] = np.nan
    scene = mi.load_dict({"type": "scene", "dome": mesh, "light": {"type": "constant"}})
    return SimpleNamespace(
        scene=scene, shape=mesh, mesh=mesh, sensors=sensors, images=images, masks=[None] * 4,
        exposures=(1.0,) * 4, names=tuple(f"view_{i:04d}.exr" for i in range(4)),
        used=(True, True, True, False), count=4, source=Path("photos"), warnings=("a sentence",),
    )  # fmt: skip


def estimate_of(capture, coverage=None, size=(40, 30)):
    layout = texels(capture.mesh, size)
    rng, count = np.random.default_rng(RNG_SEED), layout.count
    coverage = rng.integers(0, 4, count) if coverage is None else np.full(count, coverage)
    entropy = np.where(coverage > 0, rng.random(count) * 0.9, 1).astype(np.float32)
    values = {"entropy": (entropy, 1.0), "coverage": (coverage.astype(np.float32), 0.0)}
    return SimpleNamespace(
        method="spectrum",
        preset=preset("paper"),
        texels=layout,
        posterior=FakePosterior(
            rng.dirichlet(np.ones(4), count), rng.dirichlet(np.ones(5), (count, 3)).swapaxes(1, 2)
        ),
        entropy=mi.TensorXf(entropy),
        coverage=mi.UInt32(coverage.astype(np.uint32)),
        seen_per_view=np.array([5, 9, 3]),
        skipped={"texels never seen": np.int64((coverage == 0).sum())},
        timings={"Fitting": 0.25, "Broken": float("nan")},
        image=lambda name: layout.to_image(*values[name]),
    )


@pytest.fixture(scope="module")
def estimate(capture):
    return estimate_of(capture)


# --- Maps ---------------------------------------------------------------------------------


def test_maps_are_laid_out_row_by_row_from_v_0(tmp_path, estimate):
    write_maps(estimate, tmp_path)
    entropy, coverage = (stored(tmp_path / f"{name}.exr") for name in ("entropy", "coverage"))
    assert list(entropy) == list(coverage) == ["Y"]
    assert entropy["Y"].shape == (30, 40) and entropy["Y"].dtype == np.float32
    u, v = np.array(estimate.texels.uv)
    row, column = (v * 30).astype(int), (u * 40).astype(int)
    np.testing.assert_array_equal(entropy["Y"][row, column], np.array(estimate.entropy))
    np.testing.assert_array_equal(coverage["Y"][row, column], np.array(estimate.coverage))
    assert read_attributes(tmp_path / "entropy.exr")["svu:preset"] == "paper"


def test_unseen_texels_are_1_and_only_the_outside_is_a_gutter(tmp_path, estimate):
    write_maps(estimate, tmp_path, gutter=3)
    entropy, coverage = (stored(tmp_path / f"{name}.exr")["Y"] for name in ("entropy", "coverage"))
    inside = estimate.texels.inside()
    assert (entropy[inside & (coverage == 0)] == 1).all()
    assert (entropy[coverage == 0] == 1).all()  # the gutter repeats both
    # Distance of each outside texel to the charts, by brute force.
    centers, outside = np.argwhere(inside), np.argwhere(~inside)
    distance = np.linalg.norm(outside[:, None] - centers, axis=-1).min(axis=1)
    far = outside[distance > 3]
    assert len(far) and (entropy[far[:, 0], far[:, 1]] == 1).all()
    near = outside[distance <= 3]
    filled = entropy[near[:, 0], near[:, 1]]
    assert np.isin(filled, entropy[inside]).all() and (filled < 1).any()


def test_without_a_gutter_everything_outside_is_1(tmp_path, estimate):
    write_maps(estimate, tmp_path, gutter=0)
    assert (stored(tmp_path / "entropy.exr")["Y"][~estimate.texels.inside()] == 1).all()


def test_a_nan_entropy_is_not_written(tmp_path, estimate):
    broken = SimpleNamespace(**vars(estimate))
    broken.entropy = np.full(estimate.texels.count, np.nan)
    with pytest.raises(OutputError, match=r"entropy\.exr: channel Y has .* NaN"):
        write_maps(broken, tmp_path)
    assert list(tmp_path.iterdir()) == []


# --- Overview -----------------------------------------------------------------------------


def pixels(path: Path) -> np.ndarray:
    return np.array(mi.Bitmap(str(path)))[..., :3]


def test_the_overview_is_a_page_of_1600_pixels(tmp_path, capture, estimate):
    write_overview(capture, estimate, tmp_path / "overview.png")
    page = pixels(tmp_path / "overview.png")
    assert page.shape == (940, 1600, 3)
    # Both ends of viridis and the grey of unseen texels are on it.
    for color in ((253, 231, 36), (68, 1, 84), (140, 140, 147)):
        assert (np.abs(page.astype(int) - color).max(axis=2) <= 2).any(), color


@pytest.mark.parametrize("used", [(False,) * 4, (True, False, False, False)])
def test_the_overview_works_with_few_views_and_nothing_seen(tmp_path, capture, used):
    few = SimpleNamespace(**{**vars(capture), "used": used})
    write_overview(few, estimate_of(capture, coverage=0), tmp_path / "overview.png")
    assert pixels(tmp_path / "overview.png").std() > 0


def test_drawing_leaves_pyplot_alone(tmp_path, capture, estimate):
    """No window, no figure that stays in memory, no setting changed."""
    import matplotlib
    from matplotlib import pyplot

    before = dict(matplotlib.rcParams), pyplot.get_fignums()
    write_overview(capture, estimate, tmp_path / "overview.png")
    assert (dict(matplotlib.rcParams), pyplot.get_fignums()) == before


def test_the_two_views_are_far_apart(capture):
    """First the one that sees most, then the used one in the most different direction."""
    first, second = views.far_apart(capture, [5, 9, 3])
    matrices = [np.array(s.world_transform().matrix).reshape(4, 4) for s in capture.sensors]
    forward = np.array([m[:3, 2] for m in matrices])
    assert first == 1
    assert second == min((0, 2), key=lambda i: forward[i] @ forward[1])


def test_a_picture_shows_the_object_where_the_photograph_does(capture):
    sensor = capture.sensors[1]
    color = np.broadcast_to(np.float32([0.2, 0.4, 0.8]), (8, 8, 3))
    shown = views.picture(capture, color, sensor)
    assert shown.shape == (30, 40, 4)
    covered, empty = shown[..., 3] == 1, shown[..., 3] == 0
    assert covered.any() and empty.any()
    # At the edge, the 9 mask rays of a pixel and its 16 colour rays may disagree.
    assert (np.abs(shown[empty][:, :3] - 1) < 1e-6).mean() > 0.98
    hue = shown[covered][:, 2] / shown[covered][:, 0]  # shading keeps it
    assert (np.abs(hue - 4) < 1e-3).mean() > 0.98
    left, right, top, bottom = views.object_window(shown[..., 3] > 0)
    rows, columns = np.nonzero(shown[..., 3])
    assert left * 40 <= columns.min() and columns.max() < right * 40
    assert top * 30 <= rows.min() and rows.max() < bottom * 30


def test_tone_mapping_exposes_for_the_object():
    photograph = np.full((10, 10, 3), 100.0, np.float32)
    photograph[2:5, 2:5] = 4.0
    photograph[0, 0] = np.nan
    mask = np.zeros((10, 10), bool)
    mask[2:5, 2:5] = True
    mapped = views.tone_mapped(photograph, mask)
    np.testing.assert_allclose(mapped[3, 3], 1, atol=1e-6)
    np.testing.assert_allclose(mapped[0, 0], 0.5)
    assert np.isfinite(mapped).all()
    # sRGB: 18 % grey is 0.461 of full scale.
    grey = views.tone_mapped(np.array([[[0.18] * 3] + [[1.0] * 3] * 9], np.float32))
    np.testing.assert_allclose(grey[0, 0], 0.461, atol=0.005)


# --- Manifest and the whole folder --------------------------------------------------------


def refuse(token: str):
    raise ValueError(f"{token} is not JSON")


def test_the_manifest_is_plain_json(tmp_path):
    record = {
        "preset": preset("fast"), "path": Path("a/b"), "array": np.eye(2), "count": np.int64(3),
        "lanes": mi.Float([1, 2]), "nan": float("nan"), "inf": np.float32(np.inf),
        "tuple": (1, None, True), "set": {"b", "a"}, 5: "five", "ä": "ö",
    }  # fmt: skip
    write_manifest(tmp_path / "run.json", record)
    text = (tmp_path / "run.json").read_text(encoding="utf-8")
    read = json.loads(text, parse_constant=refuse)
    assert read["preset"]["degree"] == 4 and read["path"] == "a/b"
    assert read["array"] == [[1, 0], [0, 1]] and read["lanes"] == [1, 2]
    assert read["nan"] is None and read["inf"] is None
    assert read["tuple"] == [1, None, True] and read["set"] == ["a", "b"]
    assert read["5"] == "five" and read["ä"] == "ö"


def test_the_manifest_names_what_it_cannot_write(tmp_path):
    with pytest.raises(OutputError, match=r"run\.json\.outer\.inner\[1\]: a function"):
        write_manifest(tmp_path / "run.json", {"outer": {"inner": [1, refuse]}})
    assert list(tmp_path.iterdir()) == []


def test_the_environment_says_what_ran():
    record = environment_record()
    assert record["versions"]["mitsuba"] == mi.__version__
    assert record["versions"]["drjit"] == dr.__version__
    assert record["versions"]["numpy"] == np.__version__
    assert record["versions"]["OpenEXR"] and record["versions"]["svu_mi"]
    assert record["variant"] == "llvm_ad_rgb" and record["threads"] >= 1
    assert int(record["llvm"]["version"].split(".")[0]) >= 17


def test_a_run_leaves_four_files_and_nothing_else(tmp_path, capture, estimate):
    folder = tmp_path / "new" / "out"
    write_outputs(capture, estimate, folder, settings={"seed": 7}, kernels={"Fitting": 2})
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["coverage.exr", "entropy.exr", "overview.png", "run.json"]
    record = json.loads((folder / "run.json").read_text(), parse_constant=refuse)
    assert record["settings"]["given"] == {"seed": 7}
    assert record["settings"]["preset"]["name"] == "paper"
    assert record["settings"]["resolution"] == [40, 30]
    assert record["timings_s"] == {"Fitting": 0.25, "Broken": None}
    assert record["kernels_compiled"] == {"Fitting": 2}
    assert record["inputs"]["left_out"] == ["view_0003.exr"]
    assert record["warnings"] == ["a sentence"]
    seen = np.array(estimate.coverage) > 0
    assert record["result"]["texels_seen"] == seen.sum()
    area = np.array(estimate.texels.footprint, np.float64)[seen] ** 2
    known = estimate.posterior.rough.argmax(axis=1)[seen] == 0
    intervals = record["result"]["intervals"]
    assert 0.1 < intervals["known_part"]["roughness"] < 0.5
    expected = {"roughness": area[known].sum() / area.sum(), "specular": 0}
    assert intervals["known_part"] == pytest.approx(expected)
    assert intervals["median_half_width"] == pytest.approx({"roughness": 0.5, "specular": 0.25})
    assert (intervals["tolerance"], intervals["level"]) == (0.05, 0.9)


def test_a_run_that_saw_nothing_is_recorded(tmp_path, capture):
    write_outputs(capture, estimate_of(capture, coverage=0), tmp_path)
    record = json.loads((tmp_path / "run.json").read_text(), parse_constant=refuse)
    assert record["result"]["intervals"]["seen_part"] == 0
    assert record["result"]["intervals"]["known_part"] == {}


def test_a_folder_that_cannot_be_used_is_named(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("mine")
    for place, sentence in (("file", "is a file"), ("file/sub", "cannot be made")):
        with pytest.raises(OutputError, match=sentence) as caught:
            prepare_folder(tmp_path / place)
        assert str(tmp_path / place) in str(caught.value)

    def denied(**_):
        raise PermissionError(13, "Permission denied")

    # The tests may run as root, whom no permission stops.
    monkeypatch.setattr("tempfile.TemporaryFile", denied)
    with pytest.raises(OutputError, match="no file can be written there .Permission denied.") as e:
        prepare_folder(tmp_path)
    assert str(tmp_path) in str(e.value)
    assert (tmp_path / "file").read_text() == "mine"


def test_a_run_that_fails_leaves_all_as_it_was(tmp_path, capture, estimate):
    write_outputs(capture, estimate, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    broken = SimpleNamespace(**vars(estimate))
    broken.entropy = np.full(estimate.texels.count, np.nan, np.float32)
    with pytest.raises(OutputError):
        write_outputs(capture, broken, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before

"""What one command has kept, the next one reads: the same bits, and only for the same inputs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.helpers import ball, write_ball, write_scene
from support.photographs import in_integers

import svu_mi as svu
from svu_mi.capture.capture import Capture, LightUncertainty
from svu_mi.core.io.array_cache import ArrayCache
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.core.io.npz import read_arrays, write_arrays
from svu_mi.core.progress import Progress
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.observations import observe
from svu_mi.presets import Skip

MAPS = [f"{name}_{what}" for name in ("roughness", "metallic", "base_color")
        for what in ("mean", "sd", "low", "high")]  # fmt: skip
ALL = {"visibility", "statistics", "metals", "folds", "posterior"}


def estimate(capture: Capture, folder: Path | None, texels: Any, **options: Any) -> Estimate:
    kept = ArrayCache(folder, progress=(progress := Progress()))
    return svu.estimate(replace(capture, cache=kept), texels, progress=progress, **options)


def was_read(result: Estimate) -> set[str]:
    """Return what came from the folder."""
    return {stage.split()[1] for stage in result.timings if stage.startswith("Reading ")} - {"the"}


# --- the same results ----------------------------------------------------------------------------


@pytest.mark.few(1)
@pytest.mark.parametrize("clipped", [False, True], ids=["floats", "saturated"])
def test_results_are_equal_to_the_bit(vase, clipped, tmp_path):
    capture, plain = vase.capture, vase.estimate
    if clipped:
        capture, _ = in_integers(vase.capture, vase.estimate.observed, 0.3)
        plain = svu.estimate(capture, vase.texels)
    first = estimate(capture, tmp_path, vase.texels)
    second = estimate(capture, tmp_path, vase.texels)
    assert was_read(first) == set() and was_read(second) == {*ALL, "occlusion"}
    assert "Tracing occlusion" in first.timings and "Tracing occlusion" not in second.timings
    for other in (first, second):
        for name in ("entropy", "coverage", *MAPS):
            np.testing.assert_array_equal(other.image(name), plain.image(name), err_msg=name)
        for name, values in plain.posterior.draw(2).items():
            np.testing.assert_array_equal(other.posterior.draw(2)[name], values, err_msg=name)
        for name, values in plain.posterior.map().items():
            np.testing.assert_array_equal(other.posterior.map()[name], values, err_msg=name)
        np.testing.assert_array_equal(other.posterior.kernel.noise, plain.posterior.kernel.noise)
        assert other.observed.unit == plain.observed.unit
    of_cells = [each.observed.light_visibility(1024).fine.words.numpy() for each in (plain, second)]
    np.testing.assert_array_equal(*of_cells)
    assert "occlusion" in was_read(second)


@pytest.mark.parametrize(("method", "preset"), [("angular", "fixed"), ("spectrum", "default")])
def test_other_estimators_read_what_they_share(vase, tmp_path, method, preset):
    first, second = (
        estimate(vase.capture, tmp_path, vase.texels, method=method, preset=preset)
        for _ in range(2)
    )
    expected = {"visibility", "statistics" if method == "angular" else "occlusion"}
    assert was_read(first) == set() and was_read(second) == expected
    np.testing.assert_array_equal(first.image("entropy"), second.image("entropy"))


# --- only for the same inputs --------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A rendered capture of a ball, next to its scene, with all results kept."""
    at = tmp_path_factory.mktemp("at")
    (at / "scene").mkdir()
    svu.render_capture(
        write_scene(at / "scene"), spp=1, folder=at / "capture", views=3, resolution=(16, 12)
    )
    photograph(at, 1.0)  # without the id of the run
    capture = load(at)
    layout = svu.texels(capture.mesh, 12)
    first, second = (estimate(capture, at / "cache", layout) for _ in range(2))
    assert was_read(first) == set() and was_read(second) == ALL
    return SimpleNamespace(at=at, capture=capture, layout=layout, coverage=first.coverage)


def load(at: Path) -> Capture:
    return svu.load_capture(at / "capture", missing="leave-out")


def photograph(at: Path, factor: float, channel: str = "G") -> None:
    """Scale one pixel of a photograph; of channel A, of its mask."""
    path = at / "capture" / "view_0000.exr"
    planes = {name: np.array(plane) for name, plane in read_exr(path).items()}
    row, column = np.argwhere(planes["A"] >= 1)[3]
    planes[channel][row, column] *= factor
    write_exr(path, {name: planes[name] for name in "RGBA"})


def described(at: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change ``capture.json``."""
    path = at / "capture" / "capture.json"
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


def move(record: dict[str, Any]) -> None:
    record["sensors"][1]["to_world"][0][3] += 1e-4


def brighten(at: Path) -> None:
    path = at / "scene" / "scene.xml"
    emitter = '<emitter type="constant" id="light">'
    brighter = f'{emitter}<rgb name="radiance" value="1.001"/></emitter>'
    path.write_text(path.read_text().replace(f"{emitter[:-1]}/>", brighter))


OF_FILES: dict[str, Callable[[Path], Any]] = {
    "photograph": lambda at: photograph(at, 1.01),
    "mask": lambda at: photograph(at, 0.0, "A"),
    "photograph removed": lambda at: (at / "capture" / "view_0002.exr").unlink(),
    "pose": lambda at: described(at, move),
    "exposure": lambda at: described(at, lambda record: record.update(exposure=[1, 1.01, 1])),
    "light": brighten,
    "mesh": lambda at: write_ball(at / "scene", positions=ball().positions * 1.001),
    "UVs": lambda at: write_ball(at / "scene", uvs=ball().uvs * 0.99),
}
OF_OPTIONS: dict[str, tuple[dict[str, Any], set[str]]] = {
    "skip": ({"skip": Skip(pairs=False)}, set()),
    "preset": ({"preset": "fast"}, {"visibility"}),
    "known roughness": ({"known": {"roughness": 0.5}}, {"visibility", "occlusion"}),
    "known metallic": ({"known": {"metallic": 0.0}}, {"visibility", "statistics"}),
    "prior": ({"prior": np.linspace(1, 2, 8)}, {"visibility", "statistics"}),
}


def visibility_was_read(capture: Capture, side: int, folder: Path) -> bool:
    """Every key contains that of the visibility: capture, texels and code."""
    kept = ArrayCache(folder, progress=(progress := Progress()))
    observe(replace(capture, cache=kept), svu.texels(capture.mesh, side))
    return any(stage.startswith("Reading visibility") for stage in progress.timings)


@pytest.mark.parametrize("change", OF_FILES)
def test_a_changed_capture_is_never_answered_from_the_cache(scene, tmp_path, change):
    at = Path(shutil.copytree(scene.at, tmp_path / "copy"))
    assert visibility_was_read(load(at), 12, at / "cache")  # a copy is the same capture
    OF_FILES[change](at)
    assert not visibility_was_read(load(at), 12, at / "cache")


def test_other_texels_and_other_uncertainty_are_never_answered_from_the_cache(scene, tmp_path):
    kept = Path(shutil.copytree(scene.at / "cache", tmp_path / "cache"))
    assert not visibility_was_read(scene.capture, 13, kept)
    uncertain = replace(scene.capture, light_uncertainty=LightUncertainty(1.5))
    assert not visibility_was_read(uncertain, 12, kept)
    assert visibility_was_read(scene.capture, 12, kept)


@pytest.mark.parametrize("change", OF_OPTIONS)
def test_an_option_is_answered_only_from_what_it_does_not_change(scene, tmp_path, change):
    kept = Path(shutil.copytree(scene.at / "cache", tmp_path / "cache"))
    options, shared = OF_OPTIONS[change]
    assert was_read(estimate(scene.capture, kept, scene.layout, **options)) == shared


@pytest.mark.parametrize(
    ("kind", "array", "value"),
    [
        ("visibility", "order", 3), ("statistics", "texel", 144), ("posterior", "best", 64),
        ("posterior", "best_colors", 8),
    ],
)  # fmt: skip
def test_a_forged_index_is_not_used(scene, tmp_path, kind, array, value):
    """Kernels read arrays at these indices without a check."""
    shutil.copytree(scene.at / "cache", tmp_path / "cache")
    (path,) = (tmp_path / "cache").glob(f"{kind}-*")
    arrays = read_arrays(path)
    changed = arrays[array].copy()
    changed.flat[-1] = value
    write_arrays(path, arrays | {array: changed})
    result = estimate(scene.capture, tmp_path / "cache", scene.layout)
    assert kind not in was_read(result) and len(was_read(result)) >= 2
    np.testing.assert_array_equal(result.coverage, scene.coverage)
    np.testing.assert_array_equal(read_arrays(path)[array], arrays[array])  # written again

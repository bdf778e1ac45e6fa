"""Refined normals: of a mesh whose normals are tilted, and of a sound one."""

from dataclasses import replace

import numpy as np
import pytest
from support.helpers import run

import svu_mi as svu
from svu_mi import scenes
from svu_mi.calibration.checks.axis_hypotheses import with_changed_mesh
from svu_mi.calibration.normals import refine_normals as refining
from svu_mi.calibration.normals.refine_normals import refine_normals
from svu_mi.core.io.exr import read_exr
from svu_mi.core.progress import Progress
from svu_mi.output.texture_files import capture_of_textures

SIZE = 40, 36


@pytest.fixture(scope="module")
def sound():
    """The vase, 24 photographs. Read only."""
    return svu.render_capture(
        scenes.path("vase"), spp=36, views=24, resolution=(96, 96), defines={"light": "studio"}
    )


@pytest.fixture
def said(monkeypatch):
    """A progress that keeps what is said."""
    progress = Progress()
    progress.lines = []
    monkeypatch.setattr(progress, "say", progress.lines.append)
    return progress


@pytest.fixture
def small(monkeypatch):
    """Refine in one step."""
    monkeypatch.setattr(refining, "SIDES", (48,))


def with_tilts(capture, degrees):
    """Tilt all normals of the mesh smoothly, by about ``degrees``."""

    def change(mesh):
        x, y, z = mesh.positions.T / np.abs(mesh.positions).max()
        tilt = np.radians(degrees) * np.stack([np.cos(4 * y), np.sin(3 * z), np.cos(4 * x)], axis=1)
        normals = mesh.normals + tilt
        return replace(mesh, normals=normals / np.linalg.norm(normals, axis=1, keepdims=True))

    return with_changed_mesh(capture, change)


def off(capture, truth, glossy):
    """Rms angle [degrees] between the shading normals of two captures."""
    pairs = (np.array(svu.texels(one, SIZE).normal).T[glossy] for one in (capture, truth))
    cosine = np.clip(np.sum(np.multiply(*pairs), axis=1), -1, 1)
    return np.degrees(np.sqrt(np.square(np.arccos(cosine)).mean()))


def glossy_texels(capture):
    """Texels of roughness below .5 that photographs show."""
    known = svu.estimate(capture, svu.texels(capture, SIZE))
    return (np.array(known.coverage) > 4) & (np.array(known.posterior.mean("roughness")) < 0.5)


@pytest.mark.slow
def test_smooth_errors_of_glossy_surfaces_are_halved(sound, said, variant):
    wrong, glossy = with_tilts(sound, 5), glossy_texels(sound)
    refined = refine_normals(wrong, SIZE, said)
    assert off(wrong, sound, glossy) > 3.5
    assert off(refined.capture, sound, glossy) < off(wrong, sound, glossy) / 2
    assert said.lines[-1].startswith("Normals were tilted: a tilt of ")
    assert refined.normals.shape == (*SIZE[::-1], 3)
    sd = np.sqrt(np.square(refined.sd).mean())  # of all texels, of which glossy ones are certain
    assert 0.3 * sd < off(refined.capture, sound, slice(None)) < 1.5 * sd


def test_a_tilt_that_predicts_worse_is_not_kept(sound, said, small, variant, monkeypatch):
    """Normals of a sound mesh move less than half a degree; with R^2 below, not at all."""
    r2 = iter([0.9, 0.8, 0.8, 0.9])
    real = refining.estimate

    def estimate(capture, texels, **options):
        found = real(capture, texels, **options)
        return found if options else replace(found, prediction=type("", (), {"r2": next(r2)})())

    monkeypatch.setattr(refining, "estimate", estimate)
    assert refine_normals(sound, SIZE, said) is None
    assert said.lines[-1].endswith("R^2 0.800 instead of 0.900.")
    refined = refine_normals(sound, SIZE, said)
    tilt = 2 * refined.normals - 1
    assert 0 < np.degrees(np.sqrt(np.square(tilt[..., :2]).sum(axis=2).mean())) < 0.5


@pytest.mark.slow
def test_recover_writes_a_normal_map_that_its_scene_uses(
    sound, small, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("svu_mi.output.write_recovery._draw", lambda *_: None)
    folder, out = tmp_path / "capture", tmp_path / "out"
    svu.render_capture(
        scenes.path("spheres"), spp=4, views=6, resolution=(64, 64), folder=folder,
        defines={"light": "studio"},
    )  # fmt: skip
    words = "--normals", "--resolution", 32, "--steps", 5
    assert run("recover", folder, "-o", out, *words) == 0
    assert "Normals were " in capsys.readouterr().out
    tilt = 2 * np.stack([read_exr(out / "normal.exr")[c] for c in "RGB"], axis=2) - 1
    np.testing.assert_allclose(np.linalg.norm(tilt, axis=2), 1, atol=1e-5)
    assert (read_exr(out / "normal_sd.exr")["Y"] > 0).all()
    assert "normalmap" in (out / "recovered.xml").read_text()
    plain = svu.load_capture(folder)
    tilted = capture_of_textures(plain, out)
    assert tilted.warnings == plain.warnings  # it is the capture that was recovered
    angle = off(tilted, plain, slice(None))
    assert 0.01 < angle < 10

"""Unwrapping of large meshes in pieces, and their simplification."""

from __future__ import annotations

import logging
import signal

import numpy as np
import pytest
import trimesh

from svu_mi.capture import unwrap as unwrapping
from svu_mi.capture.importers.simplify_mesh import simplify
from svu_mi.capture.mesh import MeshArrays, arrays, make_mesh
from svu_mi.capture.unwrap import unwrap
from svu_mi.capture.unwrap_process import layout
from svu_mi.errors import MeshError, OptionError

SEED = 20260611


def noisy(subdivisions: int = 4) -> MeshArrays:
    ball = trimesh.creation.icosphere(subdivisions)
    noise = 0.002 * np.random.default_rng(SEED).standard_normal(ball.vertices.shape)
    return MeshArrays(np.array(ball.vertices) + noise, np.array(ball.faces), None, None)


def doubled_areas(corners: np.ndarray) -> np.ndarray:
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def test_pieces_share_one_atlas():
    mesh = noisy()
    vmap, faces, uvs = layout(mesh.positions, mesh.faces, 700)
    np.testing.assert_array_equal(vmap[faces], mesh.faces)
    assert uvs.min() >= 0 and uvs.max() <= 1
    area = np.abs(doubled_areas(uvs[faces])).sum() / 2
    assert 0.4 < area <= 1
    cross = np.cross(*(np.diff(mesh.positions[mesh.faces], axis=1).transpose(1, 0, 2)))
    density = np.abs(doubled_areas(uvs[faces])) / np.linalg.norm(cross, axis=1)
    assert np.quantile(density, 0.95) < 2 * np.quantile(density, 0.05)


def test_large_meshes_are_announced(monkeypatch, caplog):
    monkeypatch.setattr(unwrapping, "LARGE", 1000)
    monkeypatch.setattr(unwrapping, "HUGE", 1279)
    monkeypatch.setattr(unwrapping, "PERIOD", 0.01)
    mesh = noisy(3)
    with caplog.at_level(logging.WARNING):
        made = arrays(unwrap(make_mesh("ball", mesh), "scan.ply"))
    assert caplog.messages[0].startswith("scan.ply: UVs of 1280 faces are computed, which takes")
    assert caplog.messages[0].endswith("; svu import --faces 100000 simplifies it first.")
    assert caplog.messages[1].startswith("Computing UVs: ")
    corners = made.positions[made.faces]
    np.testing.assert_allclose(corners, mesh.positions[mesh.faces], atol=1e-6)


def test_interrupted_unwrapping_ends_its_process(monkeypatch):
    monkeypatch.setattr(unwrapping, "LARGE", 1000)
    monkeypatch.setattr(unwrapping.subprocess, "Popen", recorded := Recorded())
    signal.signal(signal.SIGALRM, interrupt)
    with pytest.raises(KeyboardInterrupt):
        unwrap(make_mesh("ball", noisy(3)))
    assert recorded.processes[0].wait(10) == -signal.SIGKILL  # it sleeps for 60 s


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


class Recorded:
    def __init__(self) -> None:
        self.processes: list = []
        self.make = unwrapping.subprocess.Popen

    def __call__(self, words: list[str]) -> object:
        self.processes.append(self.make(["sleep", "60"] if words else words))
        signal.setitimer(signal.ITIMER_REAL, 0.05)  # once the process is there
        return self.processes[-1]


def test_a_process_that_fails(monkeypatch):
    monkeypatch.setattr(unwrapping, "LARGE", 1000)
    monkeypatch.setattr(unwrapping.sys, "executable", "/bin/false")
    with pytest.raises(MeshError, match="scan.ply cannot be unwrapped"):
        unwrap(make_mesh("ball", noisy(3)), "scan.ply")


def test_simplified_meshes_keep_their_shape():
    ball = trimesh.creation.icosphere(5)
    mesh = MeshArrays(np.array(ball.vertices) * 250 + 1000, np.array(ball.faces), None, None)
    small, notes = simplify(mesh, 4000, "scan.ply")
    assert abs(len(small.faces) - 4000) <= 4
    np.testing.assert_allclose(np.linalg.norm(small.positions - 1000, axis=1), 250, rtol=0.01)
    assert "simplified from 20480 to" in notes[0] and "1.3 to 1.6 dB" in notes[0]
    outward = np.einsum("ij,ij->i", small.normals, small.positions - 1000) / 250
    assert np.quantile(outward, 0.01) > 0.95
    assert simplify(mesh, 20480, "scan.ply") == (mesh, [])


def test_uvs_are_not_simplified():
    mesh = noisy(3)
    with pytest.raises(OptionError, match="scan.ply: --faces would tear its UVs; add --geometry"):
        simplify(
            MeshArrays(mesh.positions, mesh.faces, None, mesh.positions[:, :2]), 500, "scan.ply"
        )

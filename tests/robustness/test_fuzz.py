"""Malformed files of every format end in one clear sentence."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from support import fuzz_formats

from svu_mi.capture import mesh as capture_mesh
from svu_mi.capture.image_io import open_image, read_planes
from svu_mi.capture.importers.mesh_files import read_textured_mesh
from svu_mi.capture.mesh import MeshArrays, arrays
from svu_mi.capture.unwrap import unwrap
from svu_mi.errors import CaptureError, MeshError

SEED = 60318
FEW, MANY = 500, 1500  # damaged files
ENOUGH = 40  # variants of a format of which some must be read, and some refused
LIMIT = 1.5 * 2**30  # bytes that the whole process may have had in use
MEMORY = Path("/dev/shm")  # a file system in memory, where there is one: 1500 files are written


@pytest.fixture(scope="module")
def report(request, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """What became of damaged files, read in a process of their own; more with slow tests."""
    if sys.platform != "linux":
        pytest.skip("the fuzzer asks /proc for the memory in use")
    is_long = any(item.get_closest_marker("slow") for item in request.session.items)
    count = MANY if is_long else FEW
    place = MEMORY if os.access(MEMORY, os.W_OK) else tmp_path_factory.getbasetemp()
    with tempfile.TemporaryDirectory(dir=place) as name:
        folder = Path(name)
        program = Path(__file__).parents[1] / "support" / "fuzzing.py"
        done = subprocess.run(
            [sys.executable, program, folder, str(count)], check=False,
            env={**os.environ, "PYTHONPATH": str(program.parents[1])},
        )  # fmt: skip
        if done.returncode != 0:
            crashes = (folder / "crashes").read_text() + (folder / "said").read_text()
            pytest.fail(
                f"the process ended with {done.returncode} at the variant "
                f"{(folder / 'current').read_text()}\n{crashes[:3000]}"
            )
        yield json.loads((folder / "report.json").read_text())


def test_damaged_files_are_read_or_refused(report):
    """In little memory, and without a trace; some are read and some refused, of every format."""
    assert not report["failures"], "\n".join(report["failures"][:20])
    assert sum(sum(count.values()) for count in report["counts"].values()) >= FEW
    assert report["peak"] < LIMIT
    for name, count in report["counts"].items():
        if (total := sum(count.values())) >= ENOUGH:
            assert 0.1 * total <= count["refused"] < total, name


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("size", [(5, 3), (40, 6)])  # too narrow to be packed, and packed
def test_float_pictures_are_those_that_mitsuba_reads(tmp_path, size):
    values = np.random.default_rng(SEED).lognormal(0, 4, (size[1], size[0], 3)).astype(np.float32)
    values[:, : size[0] // 2] = values[0, 0]  # runs
    values[0, 0] = 0
    for name in ("a.hdr", "a.pfm"):
        path = tmp_path / name
        mi.Bitmap(values).write(str(path))
        planes, low_range = read_planes(path)
        np.testing.assert_array_equal(np.stack(planes, axis=-1), np.array(mi.Bitmap(str(path))))
        assert not low_range and open_image(path).size == size
        for end in (0, 10, path.stat().st_size // 2, path.stat().st_size - 1):
            with pytest.raises(CaptureError, match="not a readable image"):
                read_planes(written(tmp_path / f"cut{path.suffix}", path.read_bytes()[:end]))


def test_pfm_of_either_order_and_any_scale(tmp_path):
    values = np.arange(6, dtype=">f4").reshape(2, 3)
    path = written(tmp_path / "grey.pfm", b"Pf\n3 2\n2.5\n" + values[::-1].tobytes())
    np.testing.assert_array_equal(read_planes(path)[0], [2.5 * values] * 3)


def test_headers_that_promise_too_much_are_refused_unread(tmp_path):
    fuzz_formats.write_integers(tmp_path, "small.png", "RGB")
    fuzz_formats.write_integers(tmp_path, "small.jpg", "RGB")
    png, jpeg = ((tmp_path / f"small.{suffix}").read_bytes() for suffix in ("png", "jpg"))
    frame = jpeg.index(b"\xff\xc0") + 5
    size = struct.pack(">HH", 65500, 65500)
    for path in (
        written(tmp_path / "a.png", png[:16] + struct.pack(">II", 16384, 16384) + png[24:]),
        written(tmp_path / "a.jpg", jpeg[:frame] + size + jpeg[frame + 4 :]),
    ):
        with pytest.raises(CaptureError, match="more than the file can hold|not a readable image"):
            read_planes(path)


def test_a_small_mesh_file_cannot_place_a_part_without_end(tmp_path):
    data = trimesh.creation.icosphere(4).export(file_type="glb")
    (length,) = struct.unpack_from("<I", data, 12)
    record = json.loads(data[20 : 20 + length])
    copies = {
        "nodes": [{"name": f"n{k}", "mesh": 0} for k in range(1000)],
        "scenes": [{"nodes": list(range(1000))}],
    }
    primitives = {"meshes": [{"primitives": record["meshes"][0]["primitives"] * 1000}]}
    for change, reason in ((copies, "too many instances"), (primitives, "reads past the end")):
        body = json.dumps({**record, **change}).encode()
        body += b" " * (-len(body) % 4)
        rest = data[20 + length :]
        sizes = 20 + len(body) + len(rest), len(body)
        head = struct.pack("<4sIII4s", b"glTF", 2, *sizes, b"JSON")
        with pytest.raises(MeshError, match=reason):
            read_textured_mesh(written(tmp_path / "copies.glb", head + body + rest))


@pytest.mark.parametrize("name", ["../secret.png", "/etc/hostname", "C:\\secret.png"])
def test_textures_outside_the_folder_of_a_mesh_are_refused(tmp_path, name):
    fuzz_formats.write_integers(tmp_path, "secret.png", "RGB")
    (tmp_path / "in").mkdir()
    fuzz_formats.write_mesh(tmp_path / "in", "mesh.gltf", painted=True)
    path = tmp_path / "in" / "mesh.gltf"
    path.write_text(path.read_text().replace('"texture.png"', json.dumps(name)))
    with pytest.raises(MeshError, match="lies outside"):
        read_textured_mesh(path)


def test_textures_that_are_not_files_cause_a_warning(tmp_path):
    fuzz_formats.write_mesh(tmp_path, "mesh.gltf", painted=True)
    (tmp_path / "texture.png").unlink()
    os.mkfifo(tmp_path / "texture.png")  # reading it would wait for ever
    about_normals, note = read_textured_mesh(tmp_path / "mesh.gltf").notes
    assert about_normals.endswith("kept sharp.")
    assert note == f"{tmp_path / 'mesh.gltf'}: refers to texture.png, which does not exist."
    (tmp_path / "texture.png").unlink()
    (tmp_path / "texture.png").write_text("<html>not found</html>")
    with pytest.raises(MeshError, match="cannot identify image file"):
        read_textured_mesh(tmp_path / "mesh.gltf")


def test_a_sliver_is_unwrapped_at_once(tmp_path):
    box = trimesh.creation.box((1, 1, 1))
    box.vertices[0, 2] = 65535
    mesh = capture_mesh.make_mesh("box", MeshArrays(box.vertices, box.faces, None, None))
    started = time.process_time()
    uvs = arrays(unwrap(mesh)).uvs
    assert time.process_time() - started < 2
    assert uvs.min() >= 0 and uvs.max() <= 1

"""Damaged meshes of a scene, and a damaged unwrapped.ply, end in one sentence, never in a crash."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import resource
import struct
import time
import zlib
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball, python, sensor_xml, write_ball, write_scene

from svu_mi.capture.analytic_shapes import analytic_mesh
from svu_mi.capture.importers.mesh_files import read_textured_mesh
from svu_mi.capture.loading import load_capture
from svu_mi.capture.mesh import MeshArrays, arrays, make_mesh, read_ply, write_ply
from svu_mi.capture.scene import load_scene
from svu_mi.capture.scene_files import check_xml
from svu_mi.capture.unwrap import UNWRAPPED, unwrap_cached
from svu_mi.cli.main import main
from svu_mi.errors import MeshError, OutputError, SceneError

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int64)
WRONG = np.where(FACES == 3, 2**31 - 1, FACES)
PROGRAM = """
import json, sys
from pathlib import Path
import svu_mi, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
mi.set_log_level(mi.LogLevel.Error)
from svu_mi.capture.scene import load_scene
from svu_mi.capture.scene_files import check_xml
from svu_mi.errors import SvuError
for name in sys.argv[1:]:
    try:
        load_scene(Path(name))
        print(json.dumps("read"))
    except SvuError as error:
        print(json.dumps(str(error)))
"""


def ply(faces: np.ndarray = FACES, *, vertices: int = 4, count: int = 4) -> bytes:
    """A PLY file without normals, so that Mitsuba computes them."""
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {count}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(faces), [("n", "u1"), ("corners", "<i4", 3)])
    rows["n"], rows["corners"] = 3, faces
    return head.encode() + CORNERS.tobytes() + rows.tobytes()


def serialized(
    faces: np.ndarray = FACES, *, vertices: int = 4, count: int = 4, version: int = 4
) -> bytes:
    body = struct.pack("<I", 0x1000) + (b"x\0" if version == 4 else b"")
    body += struct.pack("<QQ", vertices, count) + CORNERS.tobytes() + faces.astype("<u4").tobytes()
    return struct.pack("<HH", 0x041C, version) + zlib.compress(body) + struct.pack("<QI", 0, 1)


def obj(last: str) -> bytes:
    return f"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf {last}\n".encode()


DAMAGED = {
    "corner.ply": (ply(WRONG), "refers to vertex"),
    "next.ply": (ply(np.where(FACES == 3, 4, FACES)), r"vertex 4, .* \(4 vertices\); export"),
    "none.ply": (ply(vertices=0), "cannot be read|refers to vertex"),
    "cut.ply": (ply()[:-20], "cannot be read: "),
    "many.ply": (ply(count=2**32 + 4), "cannot be read: "),
    "huge.ply": (ply(vertices=10**15), "cannot be read: "),
    "most.ply": (ply(vertices=2**63), "cannot contain 9223372036854775808 elements vertex"),
    "nan.ply": (ply().replace(CORNERS.tobytes()[:4], b"\0\0\xc0\x7f"), "invalid vertex position"),
    "empty.ply": (b"", "cannot be read: "),
    "corner.serialized": (serialized(WRONG), "refers to vertex"),
    "huge.serialized": (serialized(count=10**15), "cannot contain 4 vertices and 1000000000000000"),
    "many.serialized": (serialized(vertices=2**40), "cannot contain 1099511627776 vertices"),
    "same.serialized": (serialized(vertices=2**32 + 4), "cannot contain 4294967300 vertices"),
    "third.serialized": (serialized(vertices=2**40, version=3), "cannot contain 1099511627776 ver"),
    "garbage.serialized": (struct.pack("<HH", 0x041C, 4) + b"\x78\x9c" * 99, "cannot be read: "),
    "cut.serialized": (serialized()[:30], "cannot be read: "),
    "corner.obj": (obj("1 2 9999999"), "invalid vertex 9999999"),
    "normal.obj": (obj("1//1 2//5 3//1"), "invalid normal"),
    "empty.obj": (b"", "cannot be read: "),
}  # fmt: skip


def test_damaged_meshes_of_a_scene_are_refused(tmp_path):
    """In a process of its own, which a damaged mesh ended."""
    paths = []
    for name, (data, _) in DAMAGED.items():
        (tmp_path / name).write_bytes(data)
        paths.append(tmp_path / f"{name}.xml")
        kind = name.split(".")[1]
        shape = f'<shape type="{kind}"><string name="filename" value="{name}"/></shape>'
        paths[-1].write_text(f'<scene version="3.0.0">{shape}</scene>')
    done = python("-c", PROGRAM, *paths)
    said = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, (paths[len(said)], done.stderr)
    for path, text, (name, (_, pattern)) in zip(paths, said, DAMAGED.items(), strict=True):
        assert text.startswith(f"{path}: ") and name in text.removeprefix(str(path))
        assert re.search(pattern, text), text


@pytest.mark.parametrize(("index", "version", "word"), [(0, 4, "Q"), (1, 4, "Q"), (1, 3, "I")])
def test_every_mesh_of_a_serialized_file_is_measured(tmp_path, index, version, word):
    first = serialized(version=version)[:-12]
    parts = [first, serialized(version=version)[:-12]]
    for vertices in (4, 2**40):
        parts[index] = serialized(vertices=vertices, version=version)[:-12]
        offsets = struct.pack(f"<2{word}I", 0, len(parts[0]), 2)
        (tmp_path / "two.serialized").write_bytes(b"".join(parts) + offsets)
        path = write_scene(
            tmp_path,
            extra=f'''<shape type="serialized" id="two">
            <string name="filename" value="two.serialized"/>
            <integer name="shape_index" value="{index}"/></shape>''',
        )
        if vertices == 4:
            assert "two" in [shape.id() for shape in load_scene(path).shapes()]
            continue
        with pytest.raises(SceneError, match=r"two\.serialized: .* 1099511627776 vertices"):
            load_scene(path)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("change", ['<scale value="1e308"/>', '<translate x="nan"/>'])
@pytest.mark.parametrize("kind", ["sphere", "disk"])
def test_a_shape_without_a_place_is_refused(kind, change):
    scene = mi.load_string(
        f'''<scene version="3.0.0"><shape type="{kind}" id="a">
        <transform name="to_world">{change}</transform></shape></scene>'''
    )
    with pytest.raises(SceneError, match="a has a to_world that is NaN or infinite; correct it"):
        analytic_mesh(scene.shapes()[0], "a")


def glb(nodes: list[dict[str, object]], roots: list[int], **changes: object) -> bytes:
    """A triangle, in a GLB file; ``changes`` to the accessor or view of its indices."""
    data = CORNERS[:3].tobytes() + np.array([0, 1, 2, 0], "<u2").tobytes()
    view = {"buffer": 0, "byteOffset": 36, "byteLength": 6}
    accessor = {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}
    for key, value in changes.items():
        (view if key in view else accessor)[key] = value
    corners = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
    record = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": roots}], "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [corners, accessor], "buffers": [{"byteLength": 44}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, view],
    }  # fmt: skip
    body = json.dumps(record).encode()
    body += b" " * (-len(body) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(body) + len(data), len(body), b"JSON")
    return head + body + struct.pack("<I4s", len(data), b"BIN\0") + data


def chain(depth: int) -> list[dict[str, object]]:
    return [*({"children": [k + 1]} for k in range(depth - 1)), {"mesh": 0}]


REFUSED_GLTF = {
    "deep": (glb(chain(20_000), [0]), "nested more than 500 deep"),
    "a ring": (glb([{"children": [1]}, {"children": [0], "mesh": 0}], [0]), "two parents"),
    "twice": (glb([{"children": [1, 1]}, {"mesh": 0}], [0]), "two parents"),
    "two names": (glb([{"children": [1, -1]}, {"mesh": 0}], [0]), r"nodes\[0\]: child.* got -1"),
    "sparse": (glb(chain(1), [0], sparse={"count": 1}), "indices is .*sparse"),
    "accessor before": (glb(chain(1), [0], bufferView=0, byteOffset=-8), "byteOffset must be"),
    "view before": (glb(chain(1), [0], buffer=0, byteOffset=-8), "byteOffset must be"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED_GLTF)
def test_gltf_that_another_reader_would_read_otherwise_is_refused(tmp_path, case):
    """Sparse indices were ignored, and 20 000 nested nodes took 18 s."""
    data, reason = REFUSED_GLTF[case]
    (tmp_path / "mesh.glb").write_bytes(data)
    start = time.process_time()
    with pytest.raises(MeshError, match=rf"mesh\.glb: .*({reason})"):
        read_textured_mesh(tmp_path / "mesh.glb")
    assert time.process_time() - start < 2


def test_gltf_of_500_levels_is_read(tmp_path):
    (tmp_path / "mesh.glb").write_bytes(glb(chain(500), [0]))
    np.testing.assert_array_equal(
        read_textured_mesh(tmp_path / "mesh.glb").mesh.positions, CORNERS[:3]
    )


INSIDE = '<string name="filename" value="$file"/>'
PLACES = {
    "a group": f'<shape type="shapegroup" id="g"><shape type="ply">{INSIDE}</shape></shape>'
    '<shape type="instance"><ref id="g"/></shape>',
    "merged": f'<shape type="merge"><shape type="ply">{INSIDE}</shape></shape>',
    "included": '<include filename="more.xml"/>',
    "a path": f'<path value="far"/><shape type="ply">{INSIDE}</shape>',
    "a second mesh": '<shape type="ply"><string name="filename" value="ball.ply"/></shape>'
    f'<shape type="ply">{INSIDE}</shape>',
}


@pytest.mark.parametrize("place", PLACES)
def test_a_mesh_is_found_wherever_it_is_named(tmp_path, place):
    path = write_scene(tmp_path, extra='<default name="file" value="bad.ply"/>' + PLACES[place])
    more = f'<scene version="3.0.0"><shape type="ply">{INSIDE}</shape></scene>'
    (tmp_path / "more.xml").write_text(more)
    (tmp_path / "far").mkdir()
    (tmp_path / ("far" if place == "a path" else ".") / "bad.ply").write_bytes(ply(WRONG))
    with pytest.raises(SceneError, match=r"bad\.ply: a face refers to"):
        load_scene(path)
    assert load_scene(path, {"file": "ball.ply"}).shapes()


@pytest.mark.parametrize("depth", [600, 100_000])
def test_elements_nested_without_end_are_refused(tmp_path, depth):
    words = '<bsdf type="twosided">' * depth + "</bsdf>" * depth
    with pytest.raises(SceneError, match=r"scene\.xml: elements are nested more than 500 deep"):
        load_scene(write_scene(tmp_path, extra=words))
    (tmp_path / "more.xml").write_text(f'<scene version="3.0.0">{words}</scene>')
    with pytest.raises(SceneError, match=r"more\.xml: elements are nested more than 500 deep"):
        load_scene(write_scene(tmp_path, extra='<include filename="more.xml"/>'))


def test_parameters_that_multiply_are_refused(tmp_path):
    """Ten times nine values of ten others each: 1.6 kB of XML would be 10^9 letters."""
    nested = '<default name="a0" value="aaaaaaaaaa"/>'
    for level in range(9):
        nested += f'<default name="a{level + 1}" value="{f"$a{level}" * 10}"/>'
    path = write_scene(tmp_path, extra=nested)
    with pytest.raises(SceneError, match=r"scene\.xml: .*a value has over 65536 characters.*line"):
        load_scene(path)
    spread = '<default name="a" value="' + "a" * 60_000 + '"/>'
    spread += '<bsdf type="diffuse"><string name="x" value="$a"/></bsdf>' * 300
    with pytest.raises(SceneError, match=r"values have over 16777216 characters"):
        load_scene(write_scene(tmp_path, extra=spread))
    many = "".join(f'<default name="p{k}" value="$p{k - 1}"/>' for k in range(2000))
    with pytest.raises(SceneError, match="more than 1000 parameters"):
        load_scene(write_scene(tmp_path, extra=many))


@pytest.mark.parametrize(("last", "fits"), [("", True), ("b", False)])
def test_a_value_may_have_65536_characters(tmp_path, last, fits):
    words = f'<default name="a" value="{"a" * 32_768}"/><string name="x" value="$a$a{last}"/>'
    path = write_scene(tmp_path, extra=words)
    with contextlib.nullcontext() if fits else pytest.raises(SceneError, match="over 65536"):
        check_xml(path, {})


def test_time_grows_with_the_length_of_an_attribute(tmp_path):
    """Eight times the length took 60 times as long."""

    def seconds(letters):
        path = write_scene(tmp_path, extra=f'<string name="x" value="{"a" * letters}"/>')
        times = []
        for _ in range(3):  # the least: other work only ever adds time
            start = time.process_time()
            check_xml(path, {})
            times.append(time.process_time() - start)
        return min(times)

    assert seconds(1 << 24) < 32 * max(seconds(1 << 21), 0.01)


def test_a_message_about_another_file_names_the_scene_first(tmp_path):
    path = write_scene(tmp_path, extra='<include filename="/etc/passwd"/>')
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert str(caught.value).startswith(f"{path}: /etc/passwd: not well-formed XML (")


@pytest.mark.parametrize("kind", ["ply", "obj", "serialized"])
def test_a_long_name_of_a_mesh_does_not_hide_the_reason(tmp_path, kind):
    named = f'<string name="filename" value="{"x" * 300}"/>'
    path = write_scene(tmp_path, extra=f'<shape type="{kind}">{named}</shape>')
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert str(caught.value).startswith(f"{path}: {'x' * 240}...: cannot be read: ")
    assert str(caught.value).count("xx") == 120, caught.value


def test_large_xml_is_refused_unread(tmp_path):
    path = write_scene(tmp_path)
    os.truncate(path, 1 << 40)  # a hole
    with pytest.raises(SceneError, match=r"scene\.xml: the file has more than 64 MiB"):
        load_scene(path)


@pytest.mark.parametrize("words", [
    '<string name="x" value="&foo;"/>', '<bsdf type="diffuse" type="plastic"/>',
    '<bsdf type="diffuse" id="\xe9"/>',
])  # fmt: skip
def test_xml_that_another_parser_would_refuse_is_refused(tmp_path, words):
    """Mitsuba's would go on, and read what was not looked through."""
    deep = '<bsdf type="twosided">' * 600 + "</bsdf>" * 600
    path = write_scene(tmp_path, extra=words + deep)
    path.write_bytes(path.read_text().encode("latin-1"))
    with pytest.raises(SceneError, match=r"scene\.xml: not well-formed XML \("):
        load_scene(path)


def test_includes_named_by_a_parameter_are_checked(tmp_path):
    deep = '<bsdf type="twosided">' * 600 + "</bsdf>" * 600
    (tmp_path / "more.xml").write_text(f'<scene version="3.0.0">{deep}</scene>')
    words = '<default name="f" value="less"/><include filename="$f.xml"/>'
    path = write_scene(tmp_path, extra=words)
    with pytest.raises(SceneError, match=r"more\.xml: elements are nested more than 500 deep"):
        load_scene(path, {"f": "more"})
    os.mkfifo(tmp_path / "less.xml")
    with pytest.raises(SceneError, match="less.xml, which is not a file"):
        load_scene(path)


@pytest.mark.parametrize(
    "words",
    [
        '<include filename="pipe"/>',
        '<texture type="uniform"><spectrum name="value" filename="pipe"/></texture>',
        '<shape type="ply"><string name="filename" value="pipe"/></shape>',
        '<texture type="bitmap"><string name="filename" value="pipe"/></texture>',
    ],
)
def test_a_pipe_is_not_waited_for(tmp_path, words):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(SceneError, match="pipe, which is not a file"):
        load_scene(write_scene(tmp_path, extra=words))


@pytest.mark.parametrize("command", ["entropy", "check", "report", "render"])
def test_commands_refuse_a_damaged_mesh(tmp_path, capsys, command):
    path = write_scene(tmp_path, sensors=sensor_xml(1))
    (tmp_path / "ball.ply").write_bytes(ply(WRONG))
    output = tmp_path / ("out.html" if command == "report" else "out")
    assert main([command, str(path), "-o", str(output)]) == 2
    error = capsys.readouterr().err
    assert "ball.ply: a face refers to vertex" in error and error.count("\n") == 1


def bare(**changes: object) -> object:
    """The ball without UVs."""
    fields = {**vars(ball(12, 6)), "uvs": None, **changes}
    return make_mesh("ball", MeshArrays(**fields))


def spoilt(folder: Path, **changes: np.ndarray) -> None:
    """Change arrays of unwrapped.ply, and keep its comment."""
    path = folder / UNWRAPPED
    comment = next(line for line in path.read_bytes().split(b"\n") if line.startswith(b"comment"))
    mesh = read_ply(path)
    normals = np.tile([0.0, 0.0, 1.0], (len(mesh.positions), 1))
    fields = {**vars(mesh), "normals": normals, **changes}
    write_ply(path, "ball", MeshArrays(**fields), comment.decode().removeprefix("comment "))


def test_uvs_that_were_kept_are_taken_again(tmp_path, caplog):
    """The mesh's own normals are taken, whatever those in the file are."""
    first = arrays(unwrap_cached(bare(), tmp_path))
    header = (tmp_path / UNWRAPPED).read_bytes().partition(b"end_header")[0]
    assert b"\ncomment svu_mi unwrapped " in header and b" xatlas " in header
    spoilt(tmp_path, normals=np.full_like(first.positions, np.nan))
    written = (tmp_path / UNWRAPPED).stat()  # its time of access may change
    again = arrays(unwrap_cached(bare(), tmp_path))
    for name in ("positions", "faces", "normals", "uvs"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    now = (tmp_path / UNWRAPPED).stat()
    assert (now.st_ino, now.st_mtime_ns) == (written.st_ino, written.st_mtime_ns)
    assert not caplog.records


def test_invalid_normals_of_a_scene_are_refused(tmp_path):
    normals = ball().normals
    normals[7] = np.nan
    with pytest.raises(SceneError, match="normals must be numbers .*, got nan; export the mesh"):
        load_capture(write_scene(tmp_path, normals=normals))


def test_other_normals_are_another_mesh(tmp_path, caplog):
    unwrap_cached(bare(), tmp_path)
    turned = np.roll(ball(12, 6).normals, 1, axis=1)
    mesh = arrays(unwrap_cached(bare(normals=turned), tmp_path))
    assert "belongs to another mesh, or was changed; the mesh is unwrapped again." in caplog.text
    source = arrays(bare(normals=turned))
    np.testing.assert_array_equal(mesh.normals[mesh.faces], source.normals[source.faces])


def rewritten(change):
    """Return what changes the bytes of a file."""
    return lambda path: path.write_bytes(change(path.read_bytes()))


def piped(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


SPOILT = {
    "moved": (lambda path: spoilt(path.parent, faces=read_ply(path).faces[::-1]), "was changed"),
    "NaN": (lambda path: spoilt(path.parent, uvs=read_ply(path).uvs + np.nan), "no finite UVs"),
    "no uvs": (lambda path: spoilt(path.parent, uvs=None), "no finite UVs"),
    "shift": (lambda path: spoilt(path.parent, uvs=read_ply(path).uvs + 0.01), "was changed"),
    "corner": (rewritten(lambda data: data[:-4] + struct.pack("<I", 2**30)), "refers to vertex"),
    "cut": (rewritten(lambda data: data[:-10]), "cannot be read"),
    "comment": (rewritten(lambda data: data.replace(b"unwrapped", b"something")), "was changed"),
    "garbage": (rewritten(lambda _: b"<html>not found</html>"), "cannot be read"),
    "pipe": (piped, "is not a file"),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "reason"), SPOILT.values(), ids=SPOILT)
def test_a_damaged_unwrapping_is_made_again(tmp_path, caplog, spoil, reason):
    good = arrays(unwrap_cached(bare(), tmp_path))
    path = tmp_path / UNWRAPPED
    data = path.read_bytes()
    spoil(path)
    with caplog.at_level(logging.WARNING):
        again = arrays(unwrap_cached(bare(), tmp_path))
    assert reason in caplog.text and f"{path}" in caplog.text
    np.testing.assert_array_equal(again.uvs, good.uvs)
    assert path.read_bytes() == data


def test_a_full_disk_is_noticed_while_a_mesh_is_written(tmp_path):
    """A limit on the size of files stands for the disk; Mitsuba itself loses the last bytes."""
    write_ball(tmp_path)
    before = (tmp_path / "ball.ply").read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) - 100, limits[1]))
    try:
        with pytest.raises(OutputError, match=r"ball\.ply: cannot be written \(File too large\)"):
            write_ply(tmp_path / "ball.ply", "ball", ball())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in tmp_path.iterdir()] == ["ball.ply"]
    assert (tmp_path / "ball.ply").read_bytes() == before

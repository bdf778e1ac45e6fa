"""Forty scenes as people write them for Mitsuba: without ids, of several shapes, with floors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from support.helpers import ball, sensor_xml

BODY = '<bsdf type="principled"/>'
GREY = '<bsdf type="diffuse"/>'
CHECKED = '<bsdf type="diffuse"><texture name="reflectance" type="checkerboard"/></bsdf>'
SHARED = '<bsdf type="principled" id="paint"><float name="roughness" value="0.3"/></bsdf>'
REF = '<ref id="paint"/>'
TWO = '<bsdf type="twosided"><bsdf type="principled"/></bsdf>'
PAINTED = '<bsdf type="principled"><texture name="base_color" type="checkerboard"/></bsdf>'
POSE = '<lookat origin="3, 1, 2.5" target="0, 0, 0" up="0, 0, 1"/>'  # of both sensors
LOW = {"rectangle": (-1, -1, 0), "disk": (-1, -1, 0), "cylinder": (-1, -1, 0)}  # others: -1
HIGH = {"rectangle": (1, 1, 0), "disk": (1, 1, 0)}  # others: 1
Corners = tuple[tuple[float, ...], tuple[float, ...]]


@dataclass(frozen=True, kw_only=True)
class Case:
    """One scene.

    Attributes:
        name: for messages.
        shapes: XML of its shapes and materials.
        choice: what ``--shape`` has to be; None if the object is found without.
        boxes: corners of the boxes of the object's shapes.
    """

    name: str
    shapes: str
    choice: str | None
    boxes: list[Corners]

    @property
    def box(self) -> np.ndarray:
        """Lowest and highest corner of the object, (2, 3)."""
        low, high = zip(*self.boxes, strict=True)
        return np.array([np.min(low, axis=0), np.max(high, axis=0)])

    def write(self, folder: Path) -> Path:
        """Write the scene and its meshes."""
        flat = ball(16, 8)
        open_ball = trimesh.Trimesh(flat.positions, flat.faces, process=False)
        for name in ("a.ply", "b.ply"):
            open_ball.export(folder / name)
        (folder / "box.obj").write_text(trimesh.creation.box((2, 2, 2)).export(file_type="obj"))
        (folder / "more.xml").write_text(f'<scene version="3.0.0">{shape("a.ply")[0]}</scene>')
        path = folder / "scene.xml"
        path.write_text(
            '<scene version="3.0.0"><integrator type="direct"/>'
            f'{sensor_xml(2, 16, 16, POSE)}<emitter type="constant"/>{self.shapes}</scene>'
        )
        return path


def shape(
    kind: str, bsdf: str = BODY, *, id: str = "", move: tuple[float, ...] = (0, 0, 0),
    scale: tuple[float, ...] = (0.5, 0.5, 0.5), extra: str = "",
) -> tuple[str, Corners]:  # fmt: skip
    """XML of a shape (or of a mesh file), and the corners of its box."""
    low, high = (
        np.add(np.multiply(corners, scale), move)
        for corners in (LOW.get(kind, (-1,) * 3), HIGH.get(kind, (1,) * 3))
    )
    file = f'<string name="filename" value="{kind}"/>' if "." in kind else ""
    place = "".join(
        f'<{tag} x="{x}" y="{y}" z="{z}"/>'
        for tag, (x, y, z) in (("scale", scale), ("translate", move))
    )
    xml = (
        f'<shape type="{kind.rpartition(".")[2]}"{f" id={chr(34)}{id}{chr(34)}" if id else ""}>'
        f'{file}<transform name="to_world">{place}</transform>{extra}{bsdf}</shape>'
    )
    return xml, (tuple(np.minimum(low, high)), tuple(np.maximum(low, high)))


def case(
    name: str, *shapes: tuple[str, Corners], object: tuple[int, ...] = (0,),
    choice: str | None = None, before: str = "", hidden: int = 0,
) -> Case:  # fmt: skip
    """A scene of shapes; ``object`` are numbers of those that belong to the object.

    The first ``hidden`` shapes are not written, because ``before`` includes them.
    """
    xml = before + "".join(text for text, _ in shapes[hidden:])
    return Case(name=name, shapes=xml, choice=choice, boxes=[shapes[k][1] for k in object])


def floor(bsdf: str = GREY, kind: str = "rectangle", id: str = "") -> tuple[str, Corners]:
    """A large shape below the object."""
    thin = (3, 3, 0.05) if kind in ("a.ply", "b.ply", "cube", "box.obj") else (3, 3, 3)
    return shape(kind, bsdf, id=id, move=(0, 0, -1), scale=thin)


LEFT, RIGHT = (-0.6, 0, 0), (0.6, 0, 0)
LID = {"move": (0, 0, 0.6), "scale": (0.4, 0.4, 0.1)}
MIRROR = (-0.5, 0.5, 0.5)
OUTSIDE = '<boolean name="flip_normals" value="true"/>'
FLAT = '<boolean name="face_normals" value="true"/>'
CENTER = '<point name="center" x="0" y="0" z="0"/><float name="radius" value="1"/>'

WITHOUT_IDS = (
    case("one mesh", shape("a.ply", GREY)),
    case("mesh on a rectangle", shape("a.ply"), floor()),
    case("two files", shape("a.ply", move=LEFT), shape("b.ply", move=RIGHT), object=(1,),
         choice="b.ply"),
    case("one file twice", shape("a.ply", move=LEFT), shape("a.ply", move=RIGHT), object=(1,),
         choice="a.ply-1"),
    case("named floor", shape("a.ply", GREY), floor(GREY, "b.ply", "floor"), choice="a.ply"),
    case("shared material", shape("box.obj", REF), floor(), before=SHARED),
    case("two sides", floor(GREY, "cube"), shape("a.ply", TWO), object=(1,)),
    case("included", shape("a.ply"), floor(), before='<include filename="more.xml"/>', hidden=1),
    case("two spheres", shape("sphere", move=LEFT), shape("sphere", move=RIGHT),
         choice="sphere-0"),
    case("material by name", shape("a.ply", GREY, move=LEFT),
         shape("a.ply", GREY.replace("/>", ' id="red"/>'), move=RIGHT), object=(1,),
         choice="a.ply-1"),
)  # fmt: skip
SEVERAL = (
    case("body and lid", shape("a.ply", REF, id="body"), shape("b.ply", REF, id="lid", **LID),
         object=(0, 1), choice="body,lid", before=SHARED),
    case("two materials", shape("a.ply", BODY, id="body"), shape("b.ply", PAINTED, id="lid", **LID),
         object=(0, 1), choice="body,lid"),
    case("two files as one", shape("a.ply", GREY), shape("b.ply", GREY, **LID), object=(0, 1),
         choice="a.ply,b.ply"),
    case("mesh and cube", shape("a.ply"), shape("cube", **LID), object=(0, 1),
         choice="a.ply,cube-1"),
    case("three parts on a floor", shape("a.ply"), shape("b.ply", **LID),
         shape("box.obj", move=RIGHT, scale=(0.1, 0.1, 0.1)), floor(PAINTED), object=(0, 1, 2),
         choice="a.ply,b.ply,box.obj"),
    case("with UVs and without", shape("box.obj"), shape("b.ply", **LID), object=(0, 1),
         choice="box.obj,b.ply"),
    case("one two-sided", shape("a.ply", TWO), shape("b.ply", **LID), object=(0, 1),
         choice="a.ply,b.ply"),
    case("flat and smooth", shape("a.ply", extra=FLAT), shape("b.ply", **LID), object=(0, 1),
         choice="a.ply,b.ply"),
    case("mesh and label", shape("a.ply"), shape("rectangle", PAINTED, move=(0, 0, 0.7)), floor(),
         object=(0, 1), choice="a.ply,rectangle-1"),
    case("second of two alike", shape("a.ply", move=LEFT), shape("a.ply", move=RIGHT),
         object=(0, 1), choice="a.ply-0,a.ply-1"),
)  # fmt: skip
PRIMITIVES = (
    case("sphere over a floor of triangles", shape("sphere", id="ball"), floor(GREY, "b.ply")),
    case("sphere by centre", shape("sphere", extra=CENTER), floor()),
    case("disk", shape("disk"), floor(GREY, "b.ply")),
    case("cylinder", shape("cylinder", TWO), floor()),
    case("cube", shape("cube"), floor()),
    case("rectangle", shape("rectangle", PAINTED), floor(GREY, "b.ply")),
    case("mirrored sphere", shape("sphere", scale=MIRROR, extra=OUTSIDE), floor()),
    case("painted sphere", shape("sphere", PAINTED)),
    case("stretched disk", shape("disk", scale=(0.8, 0.4, 1)), shape("sphere", GREY, move=LEFT)),
    case("grey cylinder", floor(), shape("cylinder", GREY), object=(1,), choice="cylinder-1"),
)  # fmt: skip
FLOORS = (
    case("checked floor", floor(CHECKED), shape("a.ply"), object=(1,)),
    case("principled floor", floor(BODY), shape("a.ply"), object=(1,), choice="a.ply"),
    case("material preview", shape("a.ply", REF), shape("b.ply", GREY, scale=(0.4,) * 3),
         floor(CHECKED), floor(GREY, "cube"), before=SHARED),
    case("shell and core", floor(CHECKED), shape("a.ply", REF, id="shell"),
         shape("b.ply", REF, id="core", scale=(0.4,) * 3), object=(1, 2), choice="shell,core",
         before=SHARED),
    case("grey sphere on a cube", floor(GREY, "cube"), shape("sphere", GREY), object=(1,),
         choice="sphere-1"),
    case("disk as floor", floor(GREY, "disk"), shape("a.ply"), object=(1,)),
    case("floor file", floor(BODY, "b.ply"), shape("a.ply"), object=(1,), choice="a.ply"),
    case("named object", floor(BODY, id="ground"), shape("cube", id="my box"), object=(1,),
         choice="my box"),
    case("stage", floor(), shape("rectangle", CHECKED, move=(0, 0, -2), scale=(3, 3, 3)),
         shape("box.obj"), object=(2,)),
    case("grey world", floor(), shape("a.ply", GREY), object=(1,), choice="a.ply"),
)  # fmt: skip
SCENES = (*WITHOUT_IDS, *SEVERAL, *PRIMITIVES, *FLOORS)

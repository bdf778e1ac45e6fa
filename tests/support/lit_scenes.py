"""Twenty scenes with lamps and several shapes, as tutorials, exporters and galleries write them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from support.helpers import sensor_xml, write_ball
from svu_mi.core.io.exr import write_exr

VIEWS, FILM = 5, 24
PATH = '<integrator type="path"><integer name="max_depth" value="4"/></integrator>'
SKY = '<emitter type="constant"><rgb name="radiance" value="0.4"/></emitter>'
MAP = (
    '<emitter type="envmap"><string name="filename" value="sky.exr"/><transform name="to_world">'
    '<rotate x="1" angle="0"/><rotate y="1" angle="40"/></transform></emitter>'
)


def bsdf(kind: str, inside: str = "", id: str = "") -> str:
    """XML of a BSDF."""
    return f'<bsdf type="{kind}"{f" id={chr(34)}{id}{chr(34)}" if id else ""}>{inside}</bsdf>'


def color(name: str, value: str) -> str:
    """XML of a colour."""
    return f'<rgb name="{name}" value="{value}"/>'


def number(**values: float) -> str:
    """XML of numbers."""
    return "".join(f'<float name="{name}" value="{value}"/>' for name, value in values.items())


def picture(name: str, raw: str = "true") -> str:
    """XML of a bitmap."""
    return (
        f'<texture type="bitmap" name="{name}"><string name="filename" value="{name}.exr"/>'
        f'<boolean name="raw" value="{raw}"/></texture>'
    )


def shape(kind: str, material: str, place: str = "", id: str = "", extra: str = "") -> str:
    """XML of a shape, or of a mesh file."""
    file = f'<string name="filename" value="{kind}"/>' if "." in kind else ""
    pose = f'<transform name="to_world">{place}</transform>' if place else ""
    name = f' id="{id}"' if id else ""
    return f'<shape type="{kind.rpartition(".")[2]}"{name}>{file}{pose}{extra}{material}</shape>'


def moved(x: float, y: float, z: float, scale: float = 1) -> str:
    """XML of a transform."""
    return f'<scale value="{scale}"/><translate x="{x}" y="{y}" z="{z}"/>'


def lamp(place: str, radiance: str = "8", kind: str = "rectangle", id: str = "") -> str:
    """XML of an area light."""
    light = f'<emitter type="area">{color("radiance", radiance)}</emitter>'
    return shape(kind, "", place, id, light)


def ref(id: str) -> str:
    """XML of a reference to a BSDF."""
    return f'<ref id="{id}"/>'


PAINT = bsdf("principled", color("base_color", "0.6, 0.2, 0.1") + number(roughness=0.4))
WHITE = bsdf("diffuse", color("reflectance", "0.885809, 0.698859, 0.666422"), "white")
RED = bsdf("diffuse", color("reflectance", "0.570068, 0.0430135, 0.0443706"), "red")
GREY = bsdf("diffuse", color("reflectance", "0.5"))
GLASS = bsdf("dielectric", '<string name="int_ior" value="bk7"/>')
GOLD = bsdf("roughconductor", '<string name="material" value="Au"/>' + number(alpha=0.2))
CHECKS = bsdf("twosided", bsdf("diffuse", '<texture name="reflectance" type="checkerboard"/>'))
DOWN = '<rotate x="1" angle="90"/><translate y="2.5"/>'  # of a rectangle that faces +Z
GROUND = '<rotate x="1" angle="-90"/><scale value="4"/><translate y="-1"/>'
BACK = '<scale value="4"/><translate z="-6"/>'
KEY = '<lookat origin="3, 3, 3" target="0, 0, 0" up="0, 1, 0"/>'
FILL = '<lookat origin="-4, 1, 3" target="0, 0, 0" up="0, 1, 0"/>'
FLOOR = shape("rectangle", GREY, GROUND)
BALL = shape("ball.ply", PAINT, id="ball")
BLENDER = (  # head of the add-on's files
    '<default name="spp" value="2"/><default name="resx" value="24"/>'
    '<integrator type="path"><integer name="max_depth" value="5"/></integrator>'
)
SAMPLER = '<sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>'
BLENDER_SENSORS = sensor_xml(VIEWS, FILM, FILM).replace('value="24"', 'value="$resx"').replace(
    "<film", f"{SAMPLER}<film"
)  # fmt: skip
WORLD = (  # Blender's axes as a matrix
    '<matrix value="1 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1"/>'
)


def blender(material: str, *others: str) -> str:
    """XML of the add-on: materials by name, then lights, then meshes that refer to them."""
    mesh = shape("ball.ply", ref("mat-Material"), WORLD, "mesh-Sphere")
    light = lamp(f"<scale value='.5'/>{DOWN}", "20, 20, 18", id="Area")
    return f"{BLENDER}{material}{SKY}{light}{mesh}{''.join(others)}"


@dataclass(frozen=True, kw_only=True)
class LitScene:
    """One scene.

    Attributes:
        name: for messages.
        content: XML without sensors.
        choice: what ``--shape`` has to be; None if the object is found without.
        sensors: XML of the sensors.
        refusal: part of the sentence with which the scene is refused; None if it gives maps.
    """

    name: str
    content: str
    choice: str | None = None
    sensors: str = ""
    refusal: str | None = None

    def write(self, folder: Path) -> Path:
        """Write the scene; its files are those of ``write_files`` in the same folder."""
        path = folder / f"{self.name.replace(' ', '_')}.xml"
        sensors = self.sensors or sensor_xml(VIEWS, FILM, FILM)
        path.write_text(f'<scene version="3.0.0">{self.content}{sensors}</scene>')
        return path


def write_files(folder: Path) -> None:
    """Write the meshes and pictures to which the scenes refer."""
    write_ball(folder)
    trimesh.creation.box((1, 1, 1)).export(folder / "box.obj")
    rng = np.random.default_rng(48113)
    for name in ("sky.exr", "radiance.exr"):
        write_exr(folder / name, {"RGB": rng.uniform(0.2, 4, (8, 16, 3)).astype(np.float32)})
    tilted = rng.uniform(-0.2, 0.2, (16, 16, 3)) + [0, 0, 1]
    tilted /= np.linalg.norm(tilted, axis=2, keepdims=True)
    write_exr(folder / "normalmap.exr", {"RGB": (tilted / 2 + 0.5).astype(np.float32)})
    write_exr(folder / "height.exr", {"Y": rng.uniform(0, 0.01, (16, 16, 1)).astype(np.float32)})


TUTORIALS = (
    LitScene(name="cornell box", content=PATH + WHITE + RED
        + shape("rectangle", ref("white"), GROUND, "floor")
        + shape("rectangle", ref("red"), BACK, "back") + shape("cube", GLASS, moved(2, -0.5, 0, .4))
        + lamp(DOWN, "18.387, 13.9873, 6.75357") + BALL),
    LitScene(name="turntable", content=PATH + MAP + BALL + FLOOR),
    LitScene(name="three point lighting", content=PATH + lamp(KEY) + lamp(FILL, "2") + FLOOR
        + lamp("<lookat origin='0, 4, -3' target='0, 0, 0' up='0, 1, 0'/>", "4") + BALL),
    LitScene(name="outdoors", content=PATH + '<emitter type="sunsky"/>' + BALL
        + shape("disk", CHECKS, GROUND)),
    LitScene(name="spot on a stage", content=PATH + BALL + FLOOR + SKY
        + f'<emitter type="spot"><transform name="to_world">{KEY}</transform>'
        + color("intensity", "40") + number(cutoff_angle=30) + "</emitter>"),
    LitScene(name="two bulbs and a sun", content=PATH + FLOOR + BALL
        + "".join(f'<emitter type="point"><point name="position" x="{x}" y="2" z="2"/>'
                  f'{color("intensity", "10")}</emitter>' for x in (-3, 3))
        + '<emitter type="directional"><vector name="direction" x="0" y="-1" z="-1"/>'
        + color("irradiance", "1") + "</emitter>"),
    LitScene(name="fog", content='<integrator type="volpath"/>' + SKY + BALL
        + shape("sphere", bsdf("null"), moved(0, 0, 0, 6), "fog", '<medium type="homogeneous" '
        'name="interior"><float name="sigma_t" value="0.05"/></medium>'),
        refusal="shape 'fog' is invisible (Null)"),
)  # fmt: skip
TWO = bsdf("twosided", PAINT, "mat-Material")
EXPORTERS = (
    LitScene(name="blender default", content=blender(TWO), sensors=BLENDER_SENSORS),
    LitScene(name="blender alpha", sensors=BLENDER_SENSORS, content=blender(
        bsdf("mask", bsdf("twosided", PAINT) + number(opacity=1), "mat-Material"))),
    LitScene(name="blender normal map", sensors=BLENDER_SENSORS, content=blender(
        bsdf("twosided", bsdf("normalmap", picture("normalmap") + PAINT), "mat-Material"))),
    LitScene(name="blender bump map", sensors=BLENDER_SENSORS, content=blender(
        bsdf("twosided", bsdf("bumpmap", picture("height") + PAINT), "mat-Material"))),
    LitScene(name="blender plane and cube", sensors=BLENDER_SENSORS, content=blender(
        TWO + bsdf("twosided", PAINT, "mat-Floor"),
        shape("rectangle", ref("mat-Floor"), GROUND, "mesh-Plane"),
        shape("box.obj", ref("mat-Floor"), moved(2, -0.5, 0), "mesh-Cube")), choice="mat-Material"),
    LitScene(name="blender depth of field", content=blender(TWO),
        sensors=sensor_xml(VIEWS, FILM, FILM).replace(
            '"perspective"', '"thinlens"').replace(
            "<film", number(aperture_radius=0.1, focus_distance=4) + "<film"),
        refusal="only 'perspective' sensors are supported"),
    LitScene(name="glossy floor and glass", content=PATH + MAP + BALL
        + shape("rectangle", GOLD, GROUND) + shape("sphere", GLASS, moved(1.7, -0.5, 0, 0.5))
        + shape("sphere", bsdf("blendbsdf", number(weight=0.3) + GREY + bsdf("plastic")),
                moved(-1.7, -0.5, 0, 0.5))),
)  # fmt: skip
GALLERIES = (
    LitScene(name="teapot", choice="Mesh001", content=PATH + MAP
        + bsdf("twosided", bsdf("roughplastic", color("diffuse_reflectance", "0.9, 0.9, 0.9")
               + number(alpha=0.1)), "MaterialBSDF")
        + shape("ball.ply", ref("MaterialBSDF"), id="Mesh001")
        + shape("rectangle", CHECKS, GROUND)),
    LitScene(name="material testball", choice="Outer", content=PATH + lamp(KEY, "6") + SKY
        + shape("ball.ply", GOLD, id="Outer") + shape("box.obj", GREY, moved(0, 0, 0), "Inner")
        + shape("rectangle", CHECKS, GROUND, "Backdrop")),
    LitScene(name="two principled objects", choice="vase", content=PATH + lamp(KEY, "6") + MAP
        + FLOOR + shape("ball.ply", PAINT, id="vase")
        + shape("ball.ply", PAINT, moved(2.2, -0.4, 0, 0.6), "bowl")),
    LitScene(name="bulb in glass", content=PATH + SKY + BALL
        + lamp(moved(0, 3, 0, 0.3), "30", "sphere") + shape("sphere", bsdf("thindielectric"),
                                                            moved(0, 3, 0, 0.4))),
    LitScene(name="instances", content=PATH + SKY + BALL + FLOOR
        + '<shape type="shapegroup" id="group"><shape type="ply"><string name="filename" '
        + 'value="ball.ply"/></shape></shape>' + shape("instance", ref("group"), moved(3, 0, 0)),
        refusal="is an instance, so the scene cannot be changed"),
    LitScene(name="textured lamp", content=PATH + BALL + FLOOR
        + shape("rectangle", "", DOWN,
                extra=f'<emitter type="area">{picture("radiance")}</emitter>')),
)  # fmt: skip
LIT_SCENES = (*TUTORIALS, *EXPORTERS, *GALLERIES)

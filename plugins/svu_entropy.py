"""Mitsuba integrator that displays a per-texel map on a surface."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.checked_arguments import LONGEST
from svu_mi.core.io.exr import read_exr
from svu_mi.errors import OptionError, SceneError, excerpt
from svu_mi.plugins.registry import read, require_variant

# Control points at equal steps over [0, 1], sRGB-encoded; interpolated linearly. viridis and
# inferno approximate matplotlib's colormaps (CC0) to within 0.007.
COLORMAPS = {
    "grey": "000000 ffffff",
    "viridis": (
        "440154 470d60 48186a 482374 472d7b 453681 424086 3f4989 3b528b 375a8d 33638d "
        "2f6a8e 2c728e 297a8e 26818e 23898e 21908c 1f988b 1f9f88 21a685 28ae80 31b57b "
        "3ebc74 4cc26c 5dc963 6ece58 82d34c 96d83f abdc32 c0df24 d5e21a eae51a fde725"
    ),
    "inferno": (
        "000004 040312 0b0724 150b37 210c4a 2e0a5a 3c0965 4a0c6b 57106d 63146e 70196e "
        "7d1e6d 89226a 962766 a32b61 af315c bb3755 c63e4d d14644 db4f3b e35932 eb6528 "
        "f1711e f67f14 f98d0a fb9c06 fcab0f fbba1f f9ca32 f5d949 f2e865 f3f586 fcffa4"
    ),
}
AMBIENT = 0.35  # shading factor at grazing angles


class EntropyIntegrator(mi.SamplingIntegrator):
    r"""
    .. _integrator-svu_entropy:

    Map on a surface (:monosp:`svu_entropy`)
    ----------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - EXR image with the map in UV space (the first row is :math:`v = 0`), such as
         ``entropy.exr`` or ``coverage.exr``. The channel ``Y`` is used, or else the first one.
         With the colormap ``none``, channels R, G and B are used if present. The name ``map``
         is accepted, too.

     * - texture
       - |texture|
       - The map as a nested texture (of any name), instead of ``filename``. Bitmaps need
         ``raw`` set to |true|. |exposed|

     * - filter_type
       - |string|
       - Filter of the file: ``nearest`` or ``bilinear``. (Default: ``nearest``)

     * - colormap
       - |string|
       - ``viridis``, ``inferno`` or ``grey``; or ``none`` to output values, or RGB, unchanged.
         (Default: ``viridis``)

     * - range_min, range_max
       - |float|
       - Values at the ends of the colormap; values outside are clamped. Ignored with the
         colormap ``none``. (Default: 0 and 1)

     * - shape
       - |string|
       - Id of the shape to display the map on. (Default: all shapes with UVs that are not
         emitters)

     * - background
       - |rgb|
       - Linear colour of all other pixels; their alpha is 0. (Default: 0)

     * - shading
       - |bool|
       - Darken surfaces at grazing angles to make the shape visible. Colours then no longer
         match the colormap exactly. (Default: |false|)

    This integrator displays maps of svu_mi, such as the entropy of the reflectance, on the
    object. Lights and materials of the scene have no effect. NaN texels show the background.
    Output colours are linear; after conversion to sRGB (PNG) they equal the colormap's.

    .. warning::
        This integrator needs an RGB variant of the LLVM, CUDA or Metal backend. If ``shape``
        is given, load the scene with ``optimize=False``: Mitsuba otherwise merges shapes and
        removes their ids.

    .. tabs::
        .. code-tab:: xml
            :name: svu-entropy-integrator

            <integrator type="svu_entropy">
                <string name="filename" value="out/entropy.exr"/>
                <string name="shape" value="vase"/>
                <boolean name="shading" value="true"/>
            </integrator>

        .. code-tab:: python

            'type': 'svu_entropy',
            'filename': 'out/entropy.exr',
            'shape': 'vase',
            'shading': True
    """

    needs_light = False  # read by ``svu render``

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        require_variant("svu_entropy")
        self.colormap = read(props, "colormap", "viridis")
        if self.colormap not in (*COLORMAPS, "none"):
            raise OptionError(
                f"svu_entropy: unknown colormap {self.colormap!r}; "
                f"use {', '.join(COLORMAPS)} or none."
            )
        self.low, self.high = read(props, "range_min", 0.0), read(props, "range_max", 1.0)
        if not self.low < self.high:
            raise OptionError(
                f"svu_entropy: range_min must be below range_max, got {self.low} and {self.high}."
            )
        self.shape_id = read(props, "shape", "")
        self.background = _color(props)
        self.shading = read(props, "shading", False)
        self.source, self.texture = self._map(props)
        self.table = None if self.colormap == "none" else _table(self.colormap)

    def _map(self, props: mi.Properties) -> tuple[str, mi.Texture]:
        """Return the file name of the map, or ``nested texture``, and its texture."""
        given = [props[name] for name in ("filename", "map") if name in props]
        filter_type = read(props, "filter_type", "nearest")
        if filter_type not in ("nearest", "bilinear"):
            raise OptionError(
                f"svu_entropy: filter_type must be nearest or bilinear, got {filter_type!r}."
            )
        nested = [child for _, child in props.objects() if isinstance(child, mi.Texture)]
        files = [name for name in given if isinstance(name, str)]
        if len(nested) + len(files) != 1:
            wrong = "".join(f"; there is no property {name!r}" for name in props.unqueried())
            raise OptionError(
                "svu_entropy: needs exactly one map, as a filename or a nested texture, got "
                f"{len(nested) + len(files)}{wrong}."
            )
        if nested:
            return "nested texture", nested[0]
        return files[0], _load(files[0], filter_type, self.colormap == "none")

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        medium: mi.Medium | None = None,
        active: bool | mi.Bool = True,
    ) -> tuple[mi.Color3f, mi.Bool, list[mi.Float]]:
        """Return the map's colour where rays hit a selected shape, else the background."""
        del sampler, medium
        si = scene.ray_intersect(ray, active)
        shown = si.is_valid() & self._chosen(scene, si.shape)
        if self.table is None:
            color = self.texture.eval(si, shown)
            shown &= dr.all(dr.isfinite(color))
        else:
            value = self.texture.eval_1(si, shown)
            shown &= dr.isfinite(value)
            color = self._color(value, shown)
        if self.shading:
            cosine = dr.abs(dr.dot(si.sh_frame.n, ray.d))
            color *= dr.lerp(AMBIENT, 1, cosine)
        return dr.select(shown, color, mi.Color3f(self.background)), shown, []

    def _chosen(self, scene: mi.Scene, shape: mi.ShapePtr) -> mi.Bool:
        """Return whether a ray hit a shape that displays the map."""
        shapes = scene.shapes()
        if self.shape_id:
            targets = [s for s in shapes if s.id() == self.shape_id]
            if not targets:
                raise SceneError(
                    f"svu_entropy: the scene has no shape '{self.shape_id}'; it has "
                    f"{', '.join(repr(s.id()) for s in shapes) or 'none'}. Load it with "
                    "optimize=False to keep the ids of shapes."
                )
            return dr.any([shape == mi.ShapePtr(s) for s in targets])
        others = [s for s in shapes if s.is_emitter() or not _has_uvs(s)]
        return ~dr.any([shape == mi.ShapePtr(s) for s in others]) if others else mi.Bool(True)

    def _color(self, value: mi.Float, active: mi.Bool) -> mi.Color3f:
        """Convert a value to linear RGB by the colormap."""
        steps = dr.width(self.table) // 3 - 1
        t = dr.clip((value - self.low) / (self.high - self.low), 0, 1)
        t = dr.select(active, t, 0) * steps  # NaN cannot be converted to an index
        first = dr.minimum(mi.UInt32(t), steps - 1)
        below, above = (dr.gather(mi.Color3f, self.table, first + k, active) for k in (0, 1))
        encoded = dr.lerp(below, above, t - first)
        # Inverse sRGB transfer function (IEC 61966-2-1).
        curve = dr.power((encoded + 0.055) / 1.055, 2.4)
        return dr.select(encoded <= 0.04045, encoded / 12.92, curve)

    def aov_names(self) -> list[str]:
        """Return an empty list, because there are only colour channels."""
        return []

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Expose the texture of the map."""
        cb.put("texture", self.texture, mi.ParamFlags.NonDifferentiable)

    def to_string(self) -> str:
        """Return a description with all settings."""
        return (
            "EntropyIntegrator[\n"
            f"  map = {self.source},\n"
            f"  colormap = {self.colormap},\n"
            f"  range = [{self.low}, {self.high}],\n"
            f"  shape = {self.shape_id or 'every shape with UVs'},\n"
            f"  shading = {self.shading}\n"
            "]"
        )


def _color(props: mi.Properties) -> mi.ScalarColor3f:
    """Return the colour ``background``: an ``<rgb>``, or a number for grey."""
    value = props.get("background", 0.0)
    try:
        return mi.ScalarColor3f(value)
    except TypeError:
        raise OptionError(
            "svu_entropy: background must be an <rgb> or a number, got "
            f"{excerpt(repr(value), LONGEST)}."
        ) from None


def _has_uvs(shape: mi.Shape) -> bool:
    return not shape.is_mesh() or shape.has_vertex_texcoords()


def _load(filename: str, filter_type: str, colors: bool) -> mi.Texture:
    """Read a map as a texture; relative paths are resolved in the folder of the scene."""
    channels = read_exr(str(mi.file_resolver().resolve(filename)))
    if colors and all(name in channels for name in "RGB"):
        image = np.stack([channels[name] for name in "RGB"], axis=-1)
    else:
        image = channels.get("Y", next(iter(channels.values())))[..., None]
    return mi.load_dict(
        {
            "type": "bitmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(image)),
            "raw": True,
            "filter_type": filter_type,
            "wrap_mode": "clamp",
        },
        parallel=False,  # avoids a deadlock while the scene is loaded in parallel
    )


def _table(name: str) -> mi.Float:
    """Return the control points of a colormap, flat sRGB-encoded RGB in [0, 1]."""
    code = bytes.fromhex(COLORMAPS[name])
    return mi.Float(np.frombuffer(code, np.uint8).astype(np.float32) / 255)


mi.register_integrator("svu_entropy", lambda props: EntropyIntegrator(props))

"""Differentiable Mitsuba integrator with the reflection model of svu_mi."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.capture.replace_material import is_principled, is_two_sided
from svu_mi.capture.scene import find_environment
from svu_mi.errors import OptionError, SceneError, SvuWarning
from svu_mi.geometry.texel_materials import principled_attributes
from svu_mi.light.band_limited import MomentMap, band_limited_lighting, moment_map
from svu_mi.light.environment import read_environment
from svu_mi.parameters import NAMES
from svu_mi.plugins.registry import read, require_variant
from svu_mi.presets import ANGULAR_PRESETS, preset
from svu_mi.reflection.mix_columns import mixed_radiance
from svu_mi.reflection.principled import alpha_from_roughness
from svu_mi.reflection.render_model import PrefilteredModel, prefiltered_model, shade
from svu_mi.reflection.two_ray_visibility import FacingFrame, sample_light_visibility
from svu_mi.statistics.gather_statistics import mixing_values

# ``paper`` fits light to photographs, which a scene does not have; ``gaussian`` omits the fit.
PRESETS = {name: each for name, each in ANGULAR_PRESETS.items() if each.fit is None} | {
    "gaussian": preset("paper", method="angular", name="gaussian", fit=None)
}
REMEMBERED = 4  # size of the cache of filtered lights


class ShIntegrator(mi.SamplingIntegrator):
    r"""
    .. _integrator-svu_sh:

    Reflection of filtered light (:monosp:`svu_sh`)
    -----------------------------------------------

    .. pluginparameters::

     * - preset
       - |string|
       - Reflection model: ``default``; ``gaussian`` for the lobes of Eq. 6 of the paper, with
         Schlick's Fresnel term at the camera angle and Lambertian diffuse reflection; ``fast``
         or ``fixed``, see ``svu_mi.preset``. The paper fits light to photographs; this plugin
         reads it from the scene. (Default: ``default``)

     * - levels
       - |int|
       - Number of roughness levels of the prefiltered light, 2 to 256; the light is
         interpolated between levels. (Default: 16)

     * - occlusion
       - |bool|
       - Trace occlusion of the light: one ray for the specular lobe and one for diffuse light
         per camera ray. (Default: |true|; |false| with ``gaussian`` and ``fast``)

     * - hide_emitters
       - |bool|
       - Hide the environment from the camera; alpha is then 0 in the background.
         (Default: |false|)

     * - max_depth, rr_depth
       - |int|
       - Ignored; accepted so that this plugin can replace :ref:`prb <integrator-prb>`.
         Light is reflected once.

    This integrator renders surfaces with the :ref:`principled <bsdf-principled>` BSDF (also in
    :ref:`twosided <bsdf-twosided>`) under one environment emitter. Light is prefiltered once per
    roughness level and read in the direction of each lobe. Without occlusion, antialiasing is
    the only source of noise. Few samples are then sufficient.

    Images are differentiable in the base colour, roughness and metallic textures of the BSDF. A
    script that optimises these with ``prb`` can use this integrator instead:

        image = mi.render(scene, params, integrator=mi.load_dict({'type': 'svu_sh'}))
        dr.backward(loss(image))

    Other parameters of the BSDF are assumed to have their default values. Shapes with other
    BSDFs are rendered black, with one warning; they occlude. The light is read at the first
    render, and again after a change of its parameters. Light and visibility are not
    differentiable.

    .. warning::
        This integrator needs an RGB variant of the LLVM, CUDA or Metal backend. It does not
        compute interreflections: compare it with ``direct``, or ``path`` with ``max_depth`` 2.

    .. tabs::
        .. code-tab:: xml
            :name: svu-sh-integrator

            <integrator type="svu_sh">
                <string name="preset" value="default"/>
                <boolean name="occlusion" value="false"/>
            </integrator>

        .. code-tab:: python

            'type': 'svu_sh',
            'preset': 'default',
            'occlusion': False
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        require_variant("svu_sh")
        name, self.levels = read(props, "preset", "default"), read(props, "levels", 16)
        if name not in PRESETS:
            raise OptionError(f"svu_sh: unknown preset {name!r}; use {', '.join(PRESETS)}.")
        if not 2 <= self.levels <= 256:
            raise OptionError(f"svu_sh: levels must be in [2, 256], got {self.levels}.")
        self.switches = PRESETS[name]
        self.occlusion = read(props, "occlusion", bool(self.switches.traced))
        for ignored in ("max_depth", "rr_depth"):
            props.get(ignored, 0)
        self._lights: dict[Any, _Light] = {}
        self._warned: list[Any] = []

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        medium: mi.Medium | None = None,
        active: bool | mi.Bool = True,
    ) -> tuple[mi.Color3f, mi.Bool, list[mi.Float]]:
        """Return the radiance along a camera ray."""
        del medium
        light = self._light(scene)
        with dr.suspend_grad():
            si = scene.ray_intersect(ray, active)
            hit = active & si.is_valid()
            side, faces = _facing(scene, si, ray)
        bsdf, lit = si.bsdf(), hit & faces
        for name in NAMES:
            lit &= bsdf.has_attribute(name, hit)
        values = principled_attributes(bsdf, si, lit)
        roughness = dr.clip(values["roughness"][0], 0, 1)
        moments, visible = light.moments.at(side.normal), None
        if self.occlusion:
            alpha = alpha_from_roughness(roughness)
            diffuse, specular = sample_light_visibility(scene, sampler, si, side, alpha, lit)
            moments = [[diffuse * value for value in channel] for channel in moments]
            visible = lambda *_: specular  # noqa: E731
        parts = shade(
            light.model, roughness, side.normal, side.direction, moments,
            visible=visible, to_moments=light.moments.to_local,
        )  # fmt: skip
        color = mi.Color3f(*mixed_radiance(parts, values["base_color"], mixing_values(values)))
        color = dr.select(lit, color, 0)
        if self.hide_emitters:
            return color, hit, []
        sky = si.emitter(scene).eval(si, active & ~hit)
        return color + dr.select(hit, 0, sky), mi.Bool(active), []

    def _light(self, scene: mi.Scene) -> _Light:
        """Return the prefiltered light of a scene, cached until its parameters change."""
        if dr.flag(dr.JitFlag.FreezingScope):
            raise OptionError(
                "svu_sh: dr.freeze cannot record the filtered light; use prb in frozen functions."
            )
        emitter = find_environment(scene, "svu_sh")
        parameters = dict(mi.traverse(emitter).items())
        key = _identity(emitter, parameters)
        if key not in self._lights:
            self._check_materials(scene)
            if len(self._lights) == REMEMBERED:
                self._lights.pop(next(iter(self._lights)))
            with dr.suspend_grad():
                lighting = band_limited_lighting(read_environment(emitter), 1)
                channels = 1 if lighting.environment.grey else 3
                model = prefiltered_model(lighting, self.switches, self.levels, channels)
                moments = moment_map(lighting.environment, channels)
                dr.eval(model, moments)
            self._lights[key] = _Light(model, moments, (emitter, parameters))
        return self._lights[key]

    def _check_materials(self, scene: mi.Scene) -> None:
        """Raise an error if no shape can be rendered; warn of shapes rendered black."""
        shapes = scene.shapes()
        black = [shape for shape in shapes if not is_principled(shape.bsdf())]
        if len(black) == len(shapes):
            raise SceneError(
                "svu_sh: no shape has a 'principled' BSDF, the only supported one; change the "
                "BSDF of the object."
            )
        new = [shape for shape in black if not any(shape == known for known in self._warned)]
        if new:
            self._warned += new
            names = ", ".join(repr(shape.id()) for shape in new)
            warnings.warn(
                f"svu_sh: shapes without a 'principled' BSDF are rendered black: {names}.",
                SvuWarning, stacklevel=2,
            )  # fmt: skip

    def aov_names(self) -> list[str]:
        """Return an empty list, because there are only colour channels."""
        return []

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Expose no parameters; all differentiable ones belong to the scene."""

    def to_string(self) -> str:
        """Return a description with all settings."""
        return (
            "ShIntegrator[\n"
            f"  preset = {self.switches.name},\n"
            f"  levels = {self.levels},\n"
            f"  occlusion = {self.occlusion},\n"
            f"  hide_emitters = {self.hide_emitters}\n"
            "]"
        )


@dataclass(frozen=True)
class _Light:
    """Prefiltered light. ``source`` keeps the emitter alive, so its cache key stays unique."""

    model: PrefilteredModel
    moments: MomentMap
    source: tuple[Any, ...]


def _facing(scene: Any, si: Any, ray: Any) -> tuple[FacingFrame, Any]:
    """Return the shading frame on the side that a ray hits, and whether it reflects."""
    cosine = dr.dot(si.sh_frame.n, -ray.d)
    turn = dr.select((cosine < 0) & _two_sided(scene, si), mi.Float(-1), mi.Float(1))
    side = FacingFrame(normal=turn * si.sh_frame.n, geometric=turn * si.n, direction=-ray.d)
    return side, (turn * cosine > 0) & (dr.dot(side.geometric, -ray.d) > 0)


def _two_sided(scene: Any, si: Any) -> Any:
    """Return whether the BSDF at a hit is two-sided; BSDF flags do not contain this."""
    kinds = {shape: is_two_sided(shape.bsdf()) for shape in scene.shapes()}
    if len(set(kinds.values())) == 1:
        return mi.Bool(all(kinds.values()))
    return dr.any([si.shape == mi.ShapePtr(shape) for shape, both in kinds.items() if both])


def _identity(emitter: Any, parameters: dict[str, Any]) -> tuple[Any, ...]:
    """Return a hashable key of an emitter and its parameters."""
    plain = tuple(value for value in parameters.values() if isinstance(value, int | float))
    return hash(emitter), plain, tuple(dr.detail.collect_indices(parameters))


mi.register_integrator("svu_sh", lambda props: ShIntegrator(props))

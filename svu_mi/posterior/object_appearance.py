"""The object, with estimated materials, for the light that it reflects onto itself.

Materials of some texels are estimated as if there were no such light, then again in the light of
these. Matte ones are as bright as in the photographs. Other texels have those of the nearest one.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.surroundings import surroundings
from svu_mi.core.arrays import evenly_spaced, to_drjit
from svu_mi.geometry.texels import filled_image
from svu_mi.light.panorama import trace_panorama
from svu_mi.parameters import MIXED
from svu_mi.posterior.calibrated_fit import fit, problem_of
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.posterior.sample_statistics import sample_factors
from svu_mi.presets import AngularPreset
from svu_mi.reflection.near_surfaces import NearSurfaces, ShownObject
from svu_mi.reflection.principled import diffuse_from_principled, specular_from_principled
from svu_mi.reflection.reflection_model import ReflectionModel
from svu_mi.reflection.render_model import PrefilteredModel, prefiltered_model
from svu_mi.reflection.roughness_levels import roughness_levels
from svu_mi.statistics.gather_statistics import Weighting

if TYPE_CHECKING:
    from svu_mi.posterior.observations import Observed

FIRST, MOST = 2**10, 2**11  # number of texels whose materials are estimated: first, and again
BRIGHTER = 4.0  # largest ratio of the photographs to radiance without the object's own light
LEVELS, PARTS = 7, 14  # numbers of roughness levels, also of light, and parts of roughness


def near_surfaces(observed: "Observed", switches: AngularPreset) -> NearSurfaces:
    """Return the surfaces whose light is modelled; the object is black without ``bounces``."""
    capture, shown, material = observed.capture, None, None
    own = AngularPreset(cells=switches.cells, levels=LEVELS, parts=PARTS)
    if switches.bounces:
        sky = prefiltered_model(observed.distant_light, own, LEVELS)
        shown = _shown_object(observed, own, sky, FIRST)
        material = _material(shown)
    scene, integrator = surroundings(capture, material)
    others = trace_panorama(capture, scene, integrator) if observed.has_reflectors else None
    found = NearSurfaces(scene, shown, others)
    if shown is None:
        return found
    own = replace(own, bounces=True)
    return replace(found, shown=_shown_object(observed.among(found), own, shown.light, MOST))


def _shown_object(
    observed: "Observed", switches: AngularPreset, sky: PrefilteredModel, count: int
) -> ShownObject:
    """Return the object; materials of ``count`` seen texels are estimated."""
    seen, every = np.flatnonzero(observed.coverage), observed.texels.count
    chosen = np.union1d(seen[evenly_spaced(len(seen), count)], evenly_spaced(every, MOST // 4))
    part = observed.subset(chosen)
    model = part.model(roughness_levels(switches.levels), switches, 3)
    roughness, metal, color = np.split(_estimated(part, model), [1, 2], axis=1)
    lamps = part.lamps(switches)
    total, *of_lamps = (
        np.stack([of_channel[0].numpy() for of_channel in light.moments], axis=1)
        for light in (model, lamps)
        if light is not None
    )  # irradiance
    photographed = part.visibility.mean_color(part.views, part.surface)
    unseen = np.isnan(photographed).any(axis=1)
    # Unseen texels have the mean reflectance of photographs; seen ones are as bright as these.
    tiny, expected = np.finfo(np.float32).tiny, _matte(color, metal, total, total)
    color[unseen] *= photographed[~unseen].sum() / max(expected[~unseen].sum(), tiny)
    mean = np.where(unseen[:, None], _matte(color, metal, total, total), photographed)
    texels = observed.texels.subset(part.seen)
    # Lobes read no light of lamps.
    matte = _matte(color, metal, total, sum(of_lamps, np.zeros(3)))
    ratio = np.clip(photographed / np.maximum(expected, tiny), 1 / BRIGHTER, BRIGHTER)
    matte *= np.where(unseen[:, None], 1, ratio)
    values = np.concatenate([matte, roughness, color, metal], axis=1).astype(np.float32)
    image = filled_image(texels, values)
    glow = mi.load_dict(_texture(filled_image(texels, mean)))
    return ShownObject(sky, to_drjit(mi.Float, image.ravel()), observed.texels.resolution, glow)


def _material(shown: ShownObject) -> Any:
    """Return the object's BSDF."""
    image = shown.values.numpy().reshape(*shown.size[::-1], -1)
    parts = np.split(image[..., 3:].clip(0, 1), [1, 4], axis=-1)
    named = zip(("roughness", "base_color", *MIXED), map(_texture, parts), strict=True)
    return mi.load_dict({"type": "principled", **dict(named)})


def _texture(image: np.ndarray) -> dict[str, Any]:
    """Return a texture of an image, (H, W, C) with row 0 at v = 0."""
    return {"type": "bitmap", "data": mi.TensorXf(image), "raw": True, "filter_type": "nearest"}


def _estimated(part: "Observed", model: ReflectionModel) -> np.ndarray:
    """Return roughness, metallic and base colour, (S, 5); unseen texels have the mean."""
    switches = model.switches
    factors = sample_factors(part, model, 3, Weighting(switches.kappa(part.unit), switches.edges))
    problem = problem_of(factors, PrincipledGrid(), part.unit, switches, None, 1)
    means = fit(problem, switches, part.unit, None).summary.mean
    found, seen = np.stack([np.array(x) for x in means], axis=1), factors.views.numpy() > 0
    found[~seen] = found[seen].mean(axis=0)
    return found


def _matte(
    color: np.ndarray, metal: np.ndarray, diffuse: np.ndarray, specular: np.ndarray
) -> np.ndarray:
    """Return the radiance of matte surfaces, (S, 3), from irradiances of both components."""
    reflected = diffuse_from_principled(color, metal) * diffuse
    return np.asarray(reflected + specular_from_principled(color, metal) * specular) / np.pi

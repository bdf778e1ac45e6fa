"""Light of a capture: its own, a given one, or a cached estimate from the photographs.

An estimate is cached in the folder ``light`` of the capture (``light-gains`` if gains were
estimated too). It is reused while the photographs are unchanged, for any options and version,
unless a value of metallic is known that the estimate lacked.
"""

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.calibration.exposure import equalized, estimate_gains, with_common_gain
from svu_mi.calibration.light.estimate_light import estimate_light
from svu_mi.calibration.light.light_estimate import FoundGains, LightEstimate
from svu_mi.calibration.light.light_folder import (
    RECORD,
    known_in,
    load_light,
    photographs_of,
    save_light,
)
from svu_mi.calibration.light.light_options import LightOptions
from svu_mi.calibration.light.light_summary import (
    channel_factors,
    gain_sentences,
    scale_sentence,
    summary_sentences,
)
from svu_mi.capture.capture import Capture, LightUncertainty
from svu_mi.capture.content_hash import photographs_key
from svu_mi.capture.importers.envmap import read_environment_map
from svu_mi.capture.importers.import_options import Light
from svu_mi.capture.load_warnings import RELATIVE_GAINS
from svu_mi.capture.replace_material import make_scene
from svu_mi.capture.scene import is_lit
from svu_mi.capture.up_direction import up_direction
from svu_mi.core.io.output_folder import claimed
from svu_mi.core.io.provenance import LIGHT
from svu_mi.core.progress import Progress
from svu_mi.errors import CaptureError, OptionError, OutputError, SceneError
from svu_mi.geometry.texels import texels

EMITTER = "found_light"  # id of the emitter
FOLDER = "light"  # in the folder of the capture
WITH_GAINS = "-gains"  # suffix of the folder of light estimated together with gains
RESOLUTION = 256  # texels per side for the estimate of the light
OPTIONS = LightOptions()


def with_light(capture: Capture, light: LightEstimate) -> Capture:
    """Return the capture with its light replaced by an estimated light.

    The uncertainty of the light inflates the noise of later estimates, if noise is estimated from
    the photographs (angular ``default`` and ``fast``); presets with fixed noise ignore it.

    Args:
        capture: Capture with or without a light; not modified.
        light: Estimated light.

    Raises:
        SceneError: The light moves with the cameras, which scenes do not support.

    Example:
        >>> lit = svu.with_light(capture, light)
        >>> lit.light_uncertainty is None
        False
    """
    if light.moves:
        raise SceneError(
            "The light moves with the camera (turntable or flash), which estimates do not support; "
            "photograph a static object under static light."
        )
    uncertainty = LightUncertainty(light.widening, tuple(float(sd) for sd in light.scale_sd))
    scene = _scene_under(capture, light.radiance, np.eye(4))
    return replace(capture, scene=scene, light_uncertainty=uncertainty, found_light=light)


def with_map(capture: Capture, light: Light) -> tuple[Capture, list[str]]:
    """Return the capture under a lat-long map, and notes."""
    pixels, to_world, notes = read_environment_map(light)
    scene = _scene_under(capture, pixels, to_world)
    return replace(capture, scene=scene, light_uncertainty=None, found_light=None), notes


def _scene_under(capture: Capture, radiance: np.ndarray, to_world: np.ndarray) -> Any:
    """Return a scene with the shapes of the capture under a map (H, W, 3)."""
    emitter = mi.load_dict({
        "type": "envmap", "id": EMITTER, "to_world": mi.ScalarTransform4f(to_world),
        "bitmap": mi.Bitmap(np.ascontiguousarray(radiance, np.float32)),
    })  # fmt: skip
    integrator = capture.scene.integrator()  # None if not set
    others = [] if integrator is None else [integrator]
    return make_scene([*capture.scene.shapes(), *others, emitter])


def with_resolved_light(
    capture: Capture, given: Light | None = None, *, elsewhere: Path | None = None,
    gains: bool | None = False, known: Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> Capture:  # fmt: skip
    """Return the capture with a light: the given one, its own, or an estimate.

    Args:
        capture: Capture loaded with ``light="optional"``.
        given: Lat-long map, or folder written by ``svu light``, which has no other axes or scale;
            replaces the light of the scene.
        elsewhere: Cache folder of the estimate, if the folder of the capture is read-only.
        gains: Estimate gains of the photographs, divide by them, and exclude outliers. None does
            so if the light is estimated, exposures are not recorded, and gains differ. Gains that
            were estimated together with ``given`` are reused.
        known: Known value of metallic, for an estimate of the light (``LightOptions.known``).
        progress: Display of the progress.
    """
    progress = progress or Progress()
    lit, estimates = _resolved(capture, given, elsewhere, gains, progress, known)
    if estimates is None:
        return lit
    for sentence in gain_sentences(estimates, capture):
        progress.say(sentence)
    return equalized(lit, estimates)


def photo_gains(
    capture: Capture, elsewhere: Path | None = None, progress: Progress | None = None
) -> FoundGains:
    """Return gains of the photographs; a missing light is estimated too.

    See ``with_resolved_light`` for arguments and errors.
    """
    _, gains = _resolved(capture, None, elsewhere, True, progress or Progress())
    assert gains is not None
    return gains


def _resolved(
    capture: Capture, given: Light | None, elsewhere: Path | None, gains: bool | None,
    progress: Progress, known: Mapping[str, float] | None = None,
) -> tuple[Capture, FoundGains | None]:  # fmt: skip
    """Return the capture with a light, and gains if available or requested."""
    lit, factors = capture, None
    if given is not None:
        lit, factors = _under_given(capture, given, progress)
    elif not is_lit(capture):
        light = _estimated(capture, elsewhere, gains, known or {}, progress)
        lit, factors = with_light(capture, light), light.gains
    if gains is None and lit.found_light is None and not capture.exposures_known:
        progress.say(
            "The exposures are not recorded, and taken as equal under the given light; if they may "
            "differ, use --gains estimate."
        )
    if gains and factors is None:
        factors = estimate_gains(lit, texels(lit.mesh, RESOLUTION), OPTIONS, progress)
    if lit.exposures_relative and lit.found_light is None:
        lit, low, high = with_common_gain(lit, texels(lit.mesh, RESOLUTION), OPTIONS, progress)
        progress.say(
            "Photographs are divided by their brightness relative to the environment map, "
            f"estimated: {channel_factors(low, high)} (90 % intervals)."
        )
    return lit, factors


def _estimated(
    capture: Capture, elsewhere: Path | None, gains: bool | None, known: Mapping[str, float],
    progress: Progress,
) -> LightEstimate:  # fmt: skip
    """Return the light estimated from photographs, from the cache if possible."""
    places = {kind: _folders(capture, elsewhere, kind) for kind in (WITH_GAINS, "")}
    unknown = gains is None and not capture.exposures_known
    key = photographs_key(capture)
    kept = [
        place for kind in places for place in places[kind] if unknown or bool(kind) == bool(gains)
    ]
    light = _load_kept(kept, key, known, progress)
    if light is None:
        progress.say("The capture has no light; estimating it from the photographs.")
        options = replace(OPTIONS, gains=bool(gains or unknown), known=known)
        light = estimate_light(capture, texels(capture.mesh, RESOLUTION), options, progress)
        if unknown:
            light, sentence = with_needed_gains(light)
            progress.say(sentence)
        for sentence in summary_sentences(light, up_direction(capture)):
            progress.say(sentence)
        settings = {"used": asdict(options), "resolution": [RESOLUTION] * 2}
        _keep(light, places["" if light.gains is None else WITH_GAINS], key, settings, progress)
    return light


def keep_light(
    light: LightEstimate, capture: Capture, written: Path, settings: dict[str, Any],
    progress: Progress,
) -> None:  # fmt: skip
    """Cache a light in the folder of its capture, unless it was ``written`` there."""
    places = _folders(capture, None, "" if light.gains is None else WITH_GAINS)
    if places and not any(place.resolve() == written.resolve() for place in places):
        _keep(light, places, photographs_key(capture), settings, progress)


def _folders(capture: Capture, elsewhere: Path | None, kind: str) -> list[Path]:
    """Return the folders that may contain a cached light; ``kind`` ends their names."""
    places = [capture.source / FOLDER] if capture.source and capture.source.is_dir() else []
    places += [elsewhere] if elsewhere is not None else []
    return [place.with_name(place.name + kind) for place in places]


def with_needed_gains(light: LightEstimate) -> tuple[LightEstimate, str]:
    """Drop gains that are equal, and return a sentence about unrecorded exposures."""
    if light.gains is None or not light.gains.differ:
        return replace(light, gains=None), (
            "The exposures are not recorded; they do not differ significantly."
        )
    return light, "The exposures are not recorded, and differ: estimated gains are divided out."


def _under_given(
    capture: Capture, chosen: Light, progress: Progress
) -> tuple[Capture, FoundGains | None]:
    """Return the capture under a given light, and gains that were estimated with it."""
    given = chosen.path
    if given.is_dir():
        if chosen.scale != 1 or (chosen.to_world != np.eye(3)).any():
            raise OptionError(
                f"{given}: --environment-axes and --environment-scale are for maps; omit them for "
                "a folder of svu light."
            )
        light, key = load_light(given), photographs_of(given)
        is_same = key == photographs_key(capture)
        if not is_same and key:
            progress.say(f"{given}: using a light that was estimated from other photographs.")
        progress.say(scale_sentence(light))
        if light.gains is not None and not is_same:
            progress.say(
                f"{given}: its gains may be of other photographs and are not used; estimate gains "
                "with --gains estimate."
            )
        return with_light(capture, light), light.gains if is_same else None
    if not given.is_file():
        raise CaptureError(
            f"{given}: no such file or folder; give a folder written by svu light, or an "
            "environment map (EXR or HDR)."
        )
    with_given, notes = with_map(capture, chosen)
    if capture.exposures_relative:
        notes = [*notes, RELATIVE_GAINS]
    for note in notes:
        progress.say(note)
    return with_given, None


def _load_kept(
    places: list[Path], key: str, known: Mapping[str, float], progress: Progress
) -> LightEstimate | None:
    """Return the cached light of photographs with this key and known parameters, or None."""
    for place in places:
        if not (place / RECORD).is_file():
            continue
        if photographs_of(place) != key:
            progress.say(f"{place}: not used, as it was estimated from other photographs.")
            continue
        if not known.items() <= known_in(place).items():
            words = " ".join(f"{name}={value:g}" for name, value in known.items())
            progress.say(f"{place}: not used, as it was estimated without --known {words}.")
            continue
        try:
            light = load_light(place)
        except CaptureError as error:
            progress.say(f"{error.shell} Estimating the light again.")
            continue
        progress.say(f"Using the estimated light in {place}. {scale_sentence(light)}")
        return light
    return None


def _keep(
    light: LightEstimate, places: list[Path], key: str, settings: dict[str, Any],
    progress: Progress,
) -> None:  # fmt: skip
    """Cache the light in the first writable folder, with its key and settings."""
    for place in places:
        try:
            with claimed(
                place, LIGHT, overwrite=True
            ) as claim:  # from other photographs, or damaged
                save_light(light, claim, photographs=key, about={"settings": settings})
        except OutputError as error:
            progress.say(error.shell)
            continue
        progress.say(f"The light is cached in {place}.")
        return
    progress.say("The light cannot be cached; the next command estimates it again.")

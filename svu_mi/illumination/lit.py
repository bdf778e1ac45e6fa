"""A capture under the light that was found for it, or under another one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.record import Doubt
from svu_mi.capture.repaint import scene_of
from svu_mi.errors import SceneError
from svu_mi.formats.light import read_environment_map
from svu_mi.formats.options import Light
from svu_mi.illumination.record import LightEstimate

ID = "found_light"


def with_light(capture: Capture, light: LightEstimate) -> Capture:
    """Return the capture in a scene that has this light, and no other.

    What is estimated from it is as much less certain as the light is, if noise is estimated from
    the photographs (angular ``default`` and ``fast``); what assumes its noise takes light as given.

    Args:
        capture: with or without a light; it is not modified.
        light: of ``estimate_light``.

    Raises:
        SceneError: the light moves with the cameras, which no scene can say.
    """
    if light.moves:
        raise SceneError(
            "The light turns with the camera (a turntable, or a lamp on the camera), and nothing "
            "goes on from such a light yet; photograph an object that stands still."
        )
    doubt = Doubt(light.widening, tuple(float(sd) for sd in light.scale_sd))
    scene = _under(capture, light.radiance)
    return replace(capture, scene=scene, doubt=doubt, found_light=light)


def with_map(capture: Capture, path: str | Path) -> tuple[Capture, list[str]]:
    """Return the capture under a lat-long map in the frame of Mitsuba's ``envmap``, and remarks.

    Args:
        capture: with or without a light; it is not modified.
        path: EXR, HDR or PFM.

    Raises:
        CaptureError: it is missing, or no such map (``formats.light.read_environment_map``).
    """
    pixels, _, notes = read_environment_map(Light(path=Path(path)))
    return replace(capture, scene=_under(capture, pixels), doubt=None, found_light=None), notes


def _under(capture: Capture, radiance: np.ndarray) -> Any:
    """Return a scene of the capture's shapes under a map (H, W, 3)."""
    emitter = mi.load_dict({
        "type": "envmap", "id": ID, "bitmap": mi.Bitmap(np.ascontiguousarray(radiance, np.float32)),
    })  # fmt: skip
    integrator = capture.scene.integrator()  # None in a scene that has none
    others = [] if integrator is None else [integrator]
    return scene_of([*capture.scene.shapes(), *others, emitter])

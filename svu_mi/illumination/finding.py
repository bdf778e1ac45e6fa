"""A capture with a light: its own, a given one, or one that is found in its photographs once.

What is found is kept in the capture's folder, under ``light``, and used again as long as the
photographs are the same, with whatever options and by whichever version it was found.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from svu_mi.capture import Capture
from svu_mi.capture.fingerprint import photographs_key
from svu_mi.errors import CaptureError, OutputError
from svu_mi.illumination.estimate import estimate_light
from svu_mi.illumination.folder import RECORD, load_light, photographs_of, save_light
from svu_mi.illumination.lit import with_light, with_map
from svu_mi.illumination.options import LightOptions
from svu_mi.illumination.record import LightEstimate
from svu_mi.illumination.words import sentences
from svu_mi.progress import Progress
from svu_mi.surface import texels

FOLDER = "light"  # in the capture's folder
RESOLUTION = 256  # texels per side that it is found on, whatever is estimated afterwards
OPTIONS = LightOptions()


def illuminated(
    capture: Capture,
    given: Path | None = None,
    *,
    elsewhere: Path | None = None,
    progress: Progress | None = None,
) -> Capture:
    """Return a capture with a light; as it is, if it has one and no other is given.

    Args:
        capture: loaded with ``light="optional"``.
        given: a folder that ``svu light`` wrote, or a lat-long map in the frame of Mitsuba's
            ``envmap``; it replaces the light of the scene.
        elsewhere: folder to keep what is found in, if the capture's cannot be written.
        progress: shows what is going on.

    Raises:
        CaptureError: what is given is neither, or the photographs do not tell the light.
        SceneError: the light moves with the cameras.
    """
    progress = progress or Progress()
    if given is not None:
        return _under_given(capture, given, progress)
    if capture.environment is not None:
        return capture
    places = [capture.source / FOLDER] if capture.source and capture.source.is_dir() else []
    places += [elsewhere] if elsewhere is not None else []
    key = photographs_key(capture)
    found = _found_before(places, key, progress)
    if found is None:
        progress.say("The capture has no light: it is found in the photographs first.")
        found = estimate_light(
            capture, texels(capture.mesh, RESOLUTION), OPTIONS, progress
        )
        for sentence in sentences(found):
            progress.say(sentence)
        _keep(found, places, key, progress)
    return with_light(capture, found)


def _under_given(capture: Capture, given: Path, progress: Progress) -> Capture:
    if given.is_dir():
        found = load_light(given)
        if photographs_of(given) not in ("", photographs_key(capture)):
            progress.say(f"{given}: the light was found in other photographs; it is used as it is.")
        return with_light(capture, found)
    if not given.is_file():
        raise CaptureError(
            f"{given}: no such file or folder; give a folder that svu light wrote, or a map of the "
            "light (EXR or HDR)."
        )
    with_given, notes = with_map(capture, given)
    for note in notes:
        progress.say(note)
    return with_given


def _found_before(places: list[Path], key: str, progress: Progress) -> LightEstimate | None:
    """Return light that was kept and is of these photographs; None if there is none."""
    for place in places:
        if not (place / RECORD).is_file():
            continue
        if photographs_of(place) != key:
            progress.say(f"{place}: the light there was found in other photographs.")
            continue
        try:
            found = load_light(place)
        except CaptureError as error:
            progress.say(f"{error.shell} It is found again.")
            continue
        progress.say(f"Using the light found before in {place}.")
        return found
    return None


def _keep(found: LightEstimate, places: list[Path], key: str, progress: Progress) -> None:
    about = {"settings": {"used": asdict(OPTIONS), "resolution": [RESOLUTION, RESOLUTION]}}
    for place in places:
        try:
            save_light(found, place, photographs=key, about=about)
        except OutputError as error:
            progress.say(error.shell)
            continue
        progress.say(f"The light is kept in {place}.")
        return
    progress.say("The light is not kept: it will be found again, and be the same.")

"""A capture with a light: its own, a given one, or one that is found in its photographs once.

What is found is kept in the capture's folder, under ``light`` (``light-gains`` together with
gains), and used again as long as the
photographs are the same, with whatever options and by whichever version it was found.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

from svu_mi.capture import Capture
from svu_mi.capture.fingerprint import photographs_key
from svu_mi.errors import CaptureError, OutputError
from svu_mi.illumination.equalize import equalized, estimate_gains
from svu_mi.illumination.estimate import estimate_light
from svu_mi.illumination.folder import RECORD, load_light, photographs_of, save_light
from svu_mi.illumination.found_gains import FoundGains
from svu_mi.illumination.lit import with_light, with_map
from svu_mi.illumination.options import LightOptions
from svu_mi.illumination.record import LightEstimate
from svu_mi.illumination.words import gain_sentences, sentences
from svu_mi.progress import Progress
from svu_mi.surface import texels

FOLDER = "light"  # in the capture's folder
WITH_GAINS = "-gains"  # at the end of its name, for light that was found together with gains
RESOLUTION = 256  # texels per side that it is found on, whatever is estimated afterwards
OPTIONS = LightOptions()


def illuminated(
    capture: Capture,
    given: Path | None = None,
    *,
    elsewhere: Path | None = None,
    gains: bool = False,
    progress: Progress | None = None,
) -> Capture:
    """Return a capture with a light; as it is, if it has one and no other is given.

    Args:
        capture: loaded with ``light="optional"``.
        given: a folder that ``svu light`` wrote, or a lat-long map in the frame of Mitsuba's
            ``envmap``; it replaces the light of the scene.
        elsewhere: folder to keep what is found in, if the capture's cannot be written.
        gains: whether the photographs have gains that are not known. They are found, too, and
            divided by; photographs that do not fit are not used. Where ``given`` was found
            together with gains, those are taken.
        progress: shows what is going on.

    Raises:
        CaptureError: what is given is neither, or the photographs do not tell the light.
        SceneError: the light moves with the cameras.
    """
    progress = progress or Progress()
    lit, known = _lit(capture, given, elsewhere, gains, progress)
    if known is None:
        return lit
    for sentence in gain_sentences(known, capture):
        progress.say(sentence)
    return equalized(lit, known)


def found_gains(
    capture: Capture, elsewhere: Path | None = None, progress: Progress | None = None
) -> FoundGains:
    """Return the gains of photographs, under the light that they have or together with it.

    Args:
        capture: loaded with ``light="optional"``.
        elsewhere: folder to keep light in that is found, if the capture's cannot be written.
        progress: shows what is going on.

    Raises:
        CaptureError: the photographs do not tell them.
        SceneError: the light moves with the cameras.
    """
    _, gains = _lit(capture, None, elsewhere, True, progress or Progress())
    assert gains is not None
    return gains


def _lit(
    capture: Capture, given: Path | None, elsewhere: Path | None, gains: bool, progress: Progress
) -> tuple[Capture, FoundGains | None]:
    """Return the capture under a light, with the gains that it was found or is asked for with."""
    lit, known = capture, None
    if given is not None:
        lit, known = _under_given(capture, given, progress)
    elif capture.environment is None:
        found = _searched(capture, elsewhere, gains, progress)
        lit, known = with_light(capture, found), found.gains
    if gains and known is None:
        known = estimate_gains(lit, texels(lit.mesh, RESOLUTION), OPTIONS, progress)
    return lit, known


def _searched(
    capture: Capture, elsewhere: Path | None, gains: bool, progress: Progress
) -> LightEstimate:
    """Return the light of photographs, found now or before."""
    places = [capture.source / FOLDER] if capture.source and capture.source.is_dir() else []
    places += [elsewhere] if elsewhere is not None else []
    if gains:
        places = [place.with_name(place.name + WITH_GAINS) for place in places]
    key = photographs_key(capture)
    found = _found_before(places, key, progress)
    if found is None:
        progress.say("The capture has no light: it is found in the photographs first.")
        options = replace(OPTIONS, gains=gains)
        found = estimate_light(capture, texels(capture.mesh, RESOLUTION), options, progress)
        for sentence in sentences(found):
            progress.say(sentence)
        _keep(found, places, (key, options), progress)
    return found


def _under_given(
    capture: Capture, given: Path, progress: Progress
) -> tuple[Capture, FoundGains | None]:
    """Return a capture under the light that is given, and gains that were found with it."""
    if given.is_dir():
        found, is_same = load_light(given), photographs_of(given) == photographs_key(capture)
        if not is_same and photographs_of(given):
            progress.say(f"{given}: the light was found in other photographs; it is used as it is.")
        if found.gains is not None and not is_same:
            progress.say(
                f"{given}: gains were found with this light, but maybe not of these photographs; "
                "they stay as they are, and --gains estimate finds theirs."
            )
        return with_light(capture, found), found.gains if is_same else None
    if not given.is_file():
        raise CaptureError(
            f"{given}: no such file or folder; give a folder that svu light wrote, or a map of the "
            "light (EXR or HDR)."
        )
    with_given, notes = with_map(capture, given)
    for note in notes:
        progress.say(note)
    return with_given, None


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


def _keep(
    found: LightEstimate, places: list[Path], made: tuple[str, LightOptions], progress: Progress
) -> None:
    """Keep light that was made of photographs with a key and with options."""
    key, options = made
    about = {"settings": {"used": asdict(options), "resolution": [RESOLUTION, RESOLUTION]}}
    for place in places:
        try:
            save_light(found, place, photographs=key, about=about)
        except OutputError as error:
            progress.say(error.shell)
            continue
        progress.say(f"The light is kept in {place}.")
        return
    progress.say("The light is not kept: it will be found again, and be the same.")

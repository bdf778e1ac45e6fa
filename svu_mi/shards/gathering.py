"""``gather_shards``: what the photographs of a capture say, made shard by shard."""

from __future__ import annotations

import warnings
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi import __version__
from svu_mi.capture import Capture, load_capture
from svu_mi.capture.fingerprint import Key, scene_key
from svu_mi.capture.folder import stamps
from svu_mi.capture.scene import require_light, require_variant
from svu_mi.errors import CaptureError, OptionError, SvuWarning
from svu_mi.files import prepare_folder
from svu_mi.illumination.finding import illuminated
from svu_mi.illumination.folder import load_light
from svu_mi.observed import require_range, require_seen
from svu_mi.progress import Progress
from svu_mi.shards.job import Ask, Job, texels_key
from svu_mi.shards.sharded import Sharded, Tally, merged, parts
from svu_mi.surface import Texels
from svu_mi.surface import texels as lay_out

FOLDER = Path("out") / "shards"
SHARDS = 8


def gather_shards(
    client: Any | None,
    capture: Capture | str | Path,
    texels: Texels | int | tuple[int, int],
    *,
    shards: int = SHARDS,
    light: str | Path | None = None,
    folder: str | Path = FOLDER,
    progress: Progress | None = None,
) -> Sharded:
    """Share the photographs of a capture out, and find out which of them see which texels.

        sums = svu.gather_shards(client, "capture", 1024)
        estimate = svu.estimate(sums)

    Every shard's sums are a file before they are reported, so that a worker that ends costs no
    more than the shard it was at; sums that are there are not made again. They are added in the
    order of the shards, so the result does not depend on who made them, or when.

    Args:
        client: a ``distributed.Client``; its workers must see the same files as this process.
            None for this process, one shard after the other.
        capture: where it lies; or loaded, of which nothing but scene and poses is used
            (``load_capture(path, views=())`` reads no more).
        texels: of its mesh, or their number per side, or width and height.
        shards: number of parts of the photographs.
        light: a folder that ``svu light`` wrote, or a lat-long map, in the place of the scene's
            own light.
        folder: of the partial sums, which all workers see; a folder of its own for every capture
            is made in it. ``Sharded.clear`` deletes that.
        progress: shows what is going on.

    Raises:
        OptionError: fewer than one shard, or texels of another mesh.
        CaptureError: no texel is seen in any photograph, radiance is out of range, or the capture
            does not lie in files.
        SceneError: the capture has no light.
        SvuEnvironmentError: no suitable Mitsuba variant is active.
    """
    require_variant()
    progress = progress or Progress()
    given = None if light is None else Path(light).absolute()
    lit = _without_photographs(capture)
    lit = lit if given is None else _under(given, lit)
    require_light(lit)
    layout = texels if isinstance(texels, Texels) else lay_out(lit.mesh, texels)
    job = _job(lit, layout, shards, given, Path(folder))
    tally = Tally()
    found = list(parts(client, job, Ask(kind="survey"), tally, progress))
    notes = list(dict.fromkeys(str(note) for part in found for note in part["notes"]))
    for sentence in notes:
        warnings.warn(sentence, SvuWarning, stacklevel=2)
    used = tuple(np.any([part["used"] for part in found], axis=0).tolist())
    lit = replace(lit, used=used, warnings=(*lit.warnings, *notes))
    if not any(lit.used):
        raise CaptureError(f"{lit.source}: none of {lit.count} photographs can be used.")
    seen = merged(found)
    require_seen(seen.per_view, lit, clipped=seen.clipped is not None and bool(seen.clipped.any()))
    require_range(seen.scale)
    sharded = Sharded(
        capture=lit, texels=layout, seen=np.arange(layout.count), job=job, merged=seen,
        client=client, progress=progress, tally=tally,
    )  # fmt: skip
    return replace(sharded, seen=np.flatnonzero(sharded.shown))


def _without_photographs(capture: Capture | str | Path) -> Capture:
    if isinstance(capture, Capture):
        if capture.recipe is None:
            raise CaptureError(
                "gather_shards(): the capture was made in memory, where workers cannot read it; "
                "write it into a folder, and give that."
            )
        return capture
    return load_capture(capture, light="optional", views=())


def _under(light: Path, capture: Capture) -> Capture:
    if light.is_dir() and load_light(light).gains is not None:
        raise CaptureError(
            f"{light}: was found together with gains of the photographs, which shards do not know; "
            "omit the shards."
        )
    return illuminated(capture, light)


def _job(lit: Capture, layout: Texels, shards: int, light: Path | None, folder: Path) -> Job:
    """Describe the work to those who do it."""
    recipe = lit.recipe
    assert recipe is not None and lit.source is not None
    if shards < 1:
        raise OptionError(f"There must be at least one shard, got {shards}.")
    if lit.found_light is not None and light is None:
        raise OptionError(
            "gather_shards(): the light was found in the photographs; save it with "
            "svu.save_light(), and give the folder as light=.",
            shell="The light was found in the photographs; give the folder it is in with --light.",
        )
    views = [view for view in range(lit.count) if lit.used[view] or not any(lit.used)]
    chosen = [tuple(map(int, part)) for part in np.array_split(views, min(shards, len(views)))]
    load = {each.name: getattr(recipe, each.name) for each in fields(recipe)}
    load["defines"] = dict(recipe.defines)
    places = [lit.source]
    for name in ("path", "images"):
        if load[name] is not None:
            load[name] = Path(load[name]).absolute()
            places.append(load[name] if load[name].is_dir() else load[name].parent)
    places += [] if light is None else [light]
    scene = scene_key(lit.scene, lit.shape)
    kept = Path(folder).absolute()
    files = [stamp for stamp in stamps(dict.fromkeys(place.absolute() for place in places))
             if not Path(stamp[0]).is_relative_to(kept)]  # fmt: skip
    key = Key([
        __version__, {name: repr(value) for name, value in load.items()}, repr(light),
        texels_key(layout), [list(part) for part in chosen], mi.variant(), scene,
        list(lit.exposures), files,
    ]).digest()  # fmt: skip
    return Job(
        folder=prepare_folder(kept / key[:16]), load=load, light=light, key=key, scene=scene,
        resolution=layout.resolution, texels=texels_key(layout), shards=tuple(chosen),
        variant=mi.variant(), exposures=tuple(lit.exposures),
    )  # fmt: skip

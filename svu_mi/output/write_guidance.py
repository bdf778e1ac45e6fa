"""Files of ``svu guide``: proposed poses, maps of information gain, pictures."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture import scene_xml
from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import capture_key
from svu_mi.capture.image_io import quantized
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.source import frame_of
from svu_mi.capture.sensors import describe
from svu_mi.core.io.exr import write_exr
from svu_mi.core.io.files import prepare_folder
from svu_mi.core.io.output_folder import writing
from svu_mi.guidance.guidance_result import Guidance
from svu_mi.guidance.strategies import TABLE
from svu_mi.output.export.asset_images import write_png
from svu_mi.output.guidance_page import (
    file_names,
    information_gain_pictures,
    proposal_views,
    write_guidance_overview,
)
from svu_mi.output.maps import GUTTER, exr_attributes, padded_image
from svu_mi.output.run_record import RECORD, RunInfo, guidance_record, write_manifest, write_run
from svu_mi.posterior.estimate import Estimate

PLAN, PAGE = "guidance.json", "guidance.png"
POSES, SENSORS, THUMBNAILS = "transforms.json", "sensors.xml", "thumbnails"


def write_guidance(
    capture: Capture, estimate: Estimate, guidance: Guidance, folder: str | os.PathLike[str],
    run: RunInfo | None = None, *, up: tuple[float, float, float] | None = None,
    pictures: bool = True,
) -> None:  # fmt: skip
    """Write poses, maps and pictures of the proposals, ``guidance.json`` and ``run.json``.

    ``up`` is the top of the direction map (default: that of the cameras); ``pictures`` enables
    ``guidance.png`` and thumbnails.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    with writing(folder, "guide", RECORD, capture=capture_key(capture)) as draft:
        target = draft.folder
        _write_poses(capture, guidance, target)
        write_manifest(target / PLAN, plan_record(capture, estimate, guidance))
        maps = guidance.gain_maps()
        if pictures:
            looks = proposal_views(capture, guidance)
            write_guidance_overview(capture, estimate, guidance, maps, looks, target / PAGE, up)
            folder = prepare_folder(target / THUMBNAILS)
            for k, picture in enumerate(information_gain_pictures(looks, guidance, maps)):
                write_png(folder / f"proposal_{k}.png", quantized(picture[..., :3]), color=True)
        _write_maps(guidance, maps, target)
        write_run(draft, guidance_record(capture, estimate, guidance), run or RunInfo())


def _write_poses(capture: Capture, guidance: Guidance, folder: Path) -> None:
    names, sensors = file_names(capture, guidance), [p.sensor for p in guidance.proposals]
    frames = [frame_of(s, Path(name)) for s, name in zip(sensors, names, strict=True)]
    write_transforms(folder / POSES, frames)
    write_sensors(folder / SENSORS, sensors, [Path(name).stem for name in names])


def plan_record(capture: Capture, estimate: Estimate, guidance: Guidance) -> dict[str, Any]:
    """Return the content of ``guidance.json``: proposals with poses, candidates by rank."""
    ranked = enumerate(zip(guidance.proposals, file_names(capture, guidance), strict=True), 1)
    return {
        "settings": {
            "method": guidance.method,
            "preset": estimate.preset.name,
            "options": guidance.options,
            "unit of candidates' gains": TABLE[guidance.options.strategy].unit,
        },
        "photographs": sum(capture.used),
        "entropy": guidance.entropy,
        "proposals": [
            {
                "rank": rank, "candidate": proposal.candidate, "name": proposal.name, "file": file,
                **{key: getattr(proposal, key)
                   for key in ("gain", "error", "entropy", "sees", "new")},
                "pose": describe(proposal.sensor),
            }
            for rank, (proposal, file) in ranked
        ],
        "candidates": _candidate_records(guidance),
    }  # fmt: skip


def write_sensors(path: str | Path, sensors: Sequence[Any], names: Sequence[str]) -> None:
    """Write perspective sensors as a Mitsuba scene, to be loaded or included.

    ``names`` are their ids; ``-D spp=N`` sets samples per pixel.
    """
    root = scene_xml.scene()
    root.extend(scene_xml.sensor(s, name) for s, name in zip(sensors, names, strict=True))
    scene_xml.write_document(root, Path(path))


def _candidate_records(guidance: Guidance) -> list[dict[str, Any]]:
    """Return records of all candidates, best first, unreachable last."""
    names, reachable = guidance.candidates.names, guidance.candidates.reachable
    return [
        {"number": int(k), "name": names[k], "reachable": bool(reachable[k]),
         "gain": float(guidance.scores[k])}
        for k in (*guidance.ranking, *np.flatnonzero(~reachable))
    ]  # fmt: skip


def _write_maps(guidance: Guidance, maps: np.ndarray, folder: Path) -> None:
    """Write one EXR per proposal, channel Y: gain of every texel, 0 outside the charts."""
    for k, (proposal, gains) in enumerate(zip(guidance.proposals, maps, strict=True)):
        image = padded_image(guidance, gains, fill=0)
        about = exr_attributes(
            guidance, candidate=proposal.candidate, name=proposal.name, gutter=GUTTER
        )
        write_exr(folder / f"gain_{k}.exr", {"Y": image}, about)

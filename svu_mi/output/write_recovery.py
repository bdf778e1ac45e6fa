"""Files of ``svu recover``: textures, scene, maps, pictures, losses, record."""

import json
import os
from pathlib import Path

import numpy as np

from svu_mi.calibration.normals.refine_normals import RefinedNormals
from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import capture_key
from svu_mi.core.io.exr import write_exr
from svu_mi.core.io.files import write_text
from svu_mi.core.io.output_folder import writing
from svu_mi.output import object_views
from svu_mi.output.maps import (
    COVERAGE,
    exr_attributes,
    padded_image,
    write_field,
    write_maps,
    write_uncertainty,
)
from svu_mi.output.recovery_page import write_recovery_overview
from svu_mi.output.rerender import compare_renders, write_relit
from svu_mi.output.run_record import RECORD, RunInfo, recovery_record, write_run
from svu_mi.output.texture_files import write_scene
from svu_mi.output.texture_samples import SHEET, write_draws, write_sheet
from svu_mi.posterior.estimate import Estimate
from svu_mi.recovery.recovery_result import Recovery
from svu_mi.recovery.uncertainty.texture_field import TextureField

LOSSES = "losses.csv"
PAGE, RELIT = "recovery.png", "relit.png"
VIEWS = 3  # rendered views


def write_recovery(
    capture: Capture, recovery: Recovery, folder: str | os.PathLike[str],
    run: RunInfo | None = None, *, estimate: Estimate | None = None,
    field: TextureField | None = None, draws: int = 0, seed: int = 0, pictures: bool = True,
    normals: RefinedNormals | None = None,
) -> None:  # fmt: skip
    """Write textures, ``recovered.xml`` with its assets, maps, pictures, losses and ``run.json``.

    Args:
        capture: Capture of the recovery.
        recovery: Recovery to write.
        folder: Path of the folder; created if missing.
        run: Settings and kernels of the run, for ``run.json``.
        estimate: Estimate whose entropy and standard deviations are written and drawn; default:
            ``recovery.estimate``.
        field: Uncertainty of the textures; without it, ``uncertainty.exr`` is from the estimate.
        draws: Number of textures to draw from ``field`` and write to ``draws``.
        seed: Seed of these textures.
        pictures: Whether to write ``recovery.png``, ``relit.png`` and ``draws.png``.
        normals: Refined normals to write to ``normal.exr`` and ``normal_sd.exr``.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    estimate = recovery.estimate if estimate is None else estimate
    key = capture_key(capture)
    about = exr_attributes(recovery, settings=json.dumps(recovery.settings, default=str))
    with writing(folder, "recover", RECORD, capture=key) as draft:
        target = draft.folder
        write_scene(capture, recovery.textures, target, attributes=about)
        if pictures:
            _draw(capture, recovery, estimate, field, target)
        _write_uncertainty(recovery, estimate, field, target)
        if normals is not None:
            write_exr(target / "normal.exr", {"RGB": normals.normals}, about)
            write_exr(target / "normal_sd.exr", {"Y": normals.sd}, about)
        losses = enumerate(np.asarray(recovery.losses, np.float64))
        lines = ["step,loss", *(f"{step},{loss:.9g}" for step, loss in losses)]
        write_text(target / LOSSES, "\n".join(lines))
        record = recovery_record(capture, recovery, estimate)
        if field is not None and draws:
            first = write_draws(field.draw(draws, seed), target, about)
            if pictures:
                seen = getattr(estimate, "seen_per_view", None)
                (view,) = object_views.distant_views(capture, seen, 1)
                write_sheet(capture, recovery, first, target / SHEET, view)
        write_run(draft, record, run or RunInfo())


def _draw(
    capture: Capture, recovery: Recovery, estimate: Estimate | None, field: TextureField | None,
    folder: Path,
) -> None:  # fmt: skip
    """Write ``relit.png`` and ``recovery.png``."""
    chosen = object_views.distant_views(capture, getattr(estimate, "seen_per_view", None), VIEWS)
    comparisons = compare_renders(capture, recovery.textures, chosen)
    write_relit(comparisons, folder / RELIT)
    write_recovery_overview(capture, recovery, comparisons, folder / PAGE, estimate, field)


def _write_uncertainty(
    recovery: Recovery, estimate: Estimate | None, field: TextureField | None, folder: Path
) -> None:
    if estimate is None:
        coverage = padded_image(recovery, np.asarray(recovery.coverage).astype(np.float32), fill=0)
        write_exr(folder / COVERAGE, {"Y": coverage}, exr_attributes(recovery))
    else:
        write_maps(estimate, folder)
        if field is None:
            write_uncertainty(estimate, folder)
        else:
            write_field(field, folder, exr_attributes(recovery))

"""Everything that a recovery writes: textures, a scene, maps, pictures, losses, the record."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture.fingerprint import capture_key
from svu_mi.exr import write_exr
from svu_mi.files import write_text
from svu_mi.output import views
from svu_mi.output.manifest import RECORD, recovery_record, write_run
from svu_mi.output.maps import COVERAGE, header, padded, write_maps, write_uncertainty
from svu_mi.output.recovery_page import write_recovery_overview
from svu_mi.output.relit import compare, write_relit
from svu_mi.output.scene_xml import write_scene
from svu_mi.progress import Stage
from svu_mi.results.writing import writing

LOSSES = "losses.csv"
PAGE, RELIT = "recovery.png", "relit.png"
VIEWS = 3  # that pictures are made of


def write_recovery(
    capture: Any,
    recovery: Any,
    folder: str | Path,
    *,
    estimate: Any | None = None,
    settings: Mapping[str, Any] | None = None,
    kernels: Mapping[str, int] | None = None,
    consumed: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write textures, ``recovered.xml`` with its assets, maps, pictures, losses and ``run.json``.

    All of it takes the place of an older result in one step (``results.writing``).

    Args:
        capture: the ``Capture``.
        recovery: its ``Recovery``.
        folder: made if missing.
        estimate: the ``Estimate`` whose entropy and standard deviations are written and drawn; by
            default the one that the textures were recovered from, if there is one.
        settings: what the caller was asked for (command-line options, seeds).
        kernels: number of kernels compiled per stage, ``Progress.kernels``.
        consumed: files of the folder that are of no use when the result is there: checkpoints.
        progress: called with (parts done, parts in all); rendering pictures takes longest.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    estimate = recovery.estimate if estimate is None else estimate
    key = capture_key(capture)
    with writing(folder, "recover", RECORD, capture=key, consumed=consumed) as draft:
        _write_all(capture, recovery, draft.folder, estimate, progress or Stage().update)
        write_run(draft, recovery_record(capture, recovery, estimate), settings, kernels)


def _write_all(
    capture: Any, recovery: Any, folder: Path, estimate: Any | None,
    report: Callable[[int, int], None],
) -> None:  # fmt: skip
    """Write everything but the record."""
    about = header(recovery, settings=json.dumps(recovery.settings, default=str))
    write_scene(capture, recovery.textures, folder, attributes=about)
    if estimate is None:
        coverage = padded(recovery, np.asarray(recovery.coverage).astype(np.float32), fill=0)
        write_exr(folder / COVERAGE, {"Y": coverage}, header(recovery))
    else:
        write_maps(estimate, folder)
        write_uncertainty(estimate, folder)
    write_losses(recovery.losses, folder / LOSSES)
    report(1, 4)
    chosen = views.far_apart(capture, getattr(estimate, "seen_per_view", None), VIEWS)
    comparisons = compare(capture, recovery.textures, chosen)
    report(2, 4)
    write_relit(comparisons, folder / RELIT)
    report(3, 4)
    write_recovery_overview(capture, recovery, comparisons, folder / PAGE, estimate)
    report(4, 4)


def write_losses(losses: Any, path: str | Path) -> None:
    """Write ``step,loss``, one line per step of the descent.

    Raises:
        OutputError: the file cannot be written.
    """
    values = np.asarray(losses, np.float64)
    lines = ["step,loss", *(f"{step},{loss:.9g}" for step, loss in enumerate(values))]
    write_text(path, "\n".join(lines))

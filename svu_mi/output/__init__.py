"""Results as files: maps, an overview, and the record of the run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from svu_mi.capture.fingerprint import capture_key
from svu_mi.files import prepare_folder as prepare_folder
from svu_mi.output.knowledge import Knowledge as Knowledge
from svu_mi.output.manifest import RECORD as RECORD
from svu_mi.output.manifest import environment_record as environment_record
from svu_mi.output.manifest import run_record as run_record
from svu_mi.output.manifest import write_manifest as write_manifest
from svu_mi.output.manifest import write_run as write_run
from svu_mi.output.maps import write_maps as write_maps
from svu_mi.output.overview import write_overview as write_overview
from svu_mi.results.writing import writing


def write_outputs(
    capture: Any,
    estimate: Any,
    folder: str | Path,
    *,
    settings: Mapping[str, Any] | None = None,
    kernels: Mapping[str, int] | None = None,
    knowledge: Knowledge | None = None,
) -> None:
    """Write ``entropy.exr``, ``coverage.exr``, ``overview.png`` and ``run.json``.

    All of it takes the place of an older result in one step (``results.writing``).

    Args:
        capture: the ``Capture``.
        estimate: its ``Estimate``.
        folder: made if missing.
        settings: what the caller was asked for (command-line options, seeds).
        kernels: number of kernels compiled per stage, ``Progress.kernels``.
        knowledge: what the estimate says in units; computed if not given.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    knowledge = knowledge or Knowledge.of(estimate)
    with writing(folder, "entropy", RECORD, capture=capture_key(capture)) as draft:
        write_maps(estimate, draft.folder)
        write_overview(capture, estimate, draft.folder / "overview.png", knowledge)
        record = run_record(capture, estimate, knowledge)
        write_run(draft, record, settings, kernels)

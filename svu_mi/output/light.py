"""Everything that ``svu light`` writes: the light, a picture of it, the record."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from svu_mi.capture import Capture
from svu_mi.capture.fingerprint import photographs_key
from svu_mi.illumination.folder import COMMAND, RECORD, light_record, write_arrays_of
from svu_mi.illumination.light_summary import Likeness
from svu_mi.illumination.record import LightEstimate
from svu_mi.output.light_page import write_light_page
from svu_mi.output.manifest import Run, environment_record, inputs_record, write_manifest
from svu_mi.results.transaction import writing

PAGE = "light.png"


def write_light(
    capture: Capture,
    estimate: LightEstimate,
    folder: str | os.PathLike[str],
    run: Run | None = None,
    *,
    used: Mapping[str, Any] | None = None,
    against: Likeness | None = None,
    timings: Mapping[str, float] | None = None,
    pictures: bool = True,
) -> None:
    """Write ``light.exr``, ``light.npz``, ``light.png`` and ``light.json``.

    ``used`` are the options of the search, ``against`` the likeness to the capture's own light, and
    ``timings`` seconds per stage.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    run = run or Run()
    with writing(folder, COMMAND, RECORD, capture=photographs_key(capture)) as draft:
        write_arrays_of(estimate, draft)
        if pictures:
            write_light_page(capture, estimate, draft.folder / PAGE, against)
        write_manifest(draft.folder / RECORD, {
            "inputs": inputs_record(capture), **light_record(estimate), "against": against,
            "settings": {"used": used, "given": run.settings}, "timings_s": timings,
            "kernels_compiled": run.kernels, "warnings": capture.warnings,
            "environment": environment_record(), **draft.entries(),
        })  # fmt: skip

"""Files of ``svu entropy``: maps, ``overview.png`` and ``run.json``."""

import os

from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import capture_key
from svu_mi.core.io.output_folder import writing
from svu_mi.output.interval_summary import IntervalSummary
from svu_mi.output.maps import write_maps
from svu_mi.output.overview import write_overview
from svu_mi.output.run_record import RECORD, RunInfo, run_record, write_run
from svu_mi.posterior.estimate import Estimate


def write_outputs(
    capture: Capture,
    estimate: Estimate,
    folder: str | os.PathLike[str],
    run: RunInfo | None = None,
    *,
    pictures: bool = True,
) -> IntervalSummary:
    """Write ``entropy.exr``, ``coverage.exr``, ``overview.png`` and ``run.json`` in one step.

    Returns:
        Summary of the interval widths.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    # Photographs in worker processes have no digest here.
    key = "" if estimate.observed is None else capture_key(capture)
    with writing(folder, "entropy", RECORD, capture=key) as draft:
        write_maps(estimate, draft.folder)
        summary = IntervalSummary.of(estimate)
        if pictures:
            write_overview(capture, estimate, draft.folder / "overview.png", summary)
        record = run_record(capture, estimate, summary)
        write_run(draft, record, run or RunInfo())
    return summary

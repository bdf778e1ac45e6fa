"""Results as files, and pages about them.

=================  =====================  ====================================================
``light.png``      ``light_page.py``      the light (``svu light``), and all its files
``overview.png``   ``overview.py``        entropy (``svu entropy``)
``guidance.png``   ``guidance_page.py``   next photographs; all its files: ``guidance.py``
``recovery.png``   ``recovery_page.py``   recovered textures; all its files: ``recovery.py``
``relit.png``      ``relit.py``           textures under another light
``report.html``    ``report/report.py``   one file to send; ``templates/report.html``
``check.html``     ``check_page.py``      fit of a capture; ``templates/check.html``
``compare.html``   ``compare_page.py``    differences; ``templates/compare.html``
a browser          ``viewer/viewer.py``   ``svu view``
=================  =====================  ====================================================

PNG pages are blocks of panels (``style.write_page``), drawn by ``figures.py``, also for notebooks.
HTML pages extend ``templates/base.html`` and use the macros of ``templates/parts.html``;
``page.py`` writes them. Report and viewer show the maps of ``surface_maps.py``.
"""

from __future__ import annotations

import os

from svu_mi.capture import Capture
from svu_mi.capture.fingerprint import capture_key
from svu_mi.files import prepare_folder as prepare_folder
from svu_mi.output.knowledge import Knowledge as Knowledge
from svu_mi.output.manifest import RECORD as RECORD
from svu_mi.output.manifest import Run as Run
from svu_mi.output.manifest import environment_record as environment_record
from svu_mi.output.manifest import run_record as run_record
from svu_mi.output.manifest import write_manifest as write_manifest
from svu_mi.output.manifest import write_run as write_run
from svu_mi.output.maps import write_maps as write_maps
from svu_mi.output.overview import write_overview as write_overview
from svu_mi.pipeline import Estimate
from svu_mi.results.transaction import writing


def write_outputs(
    capture: Capture,
    estimate: Estimate,
    folder: str | os.PathLike[str],
    run: Run | None = None,
    *,
    knowledge: Knowledge | None = None,
    pictures: bool = True,
) -> None:
    """Write ``entropy.exr``, ``coverage.exr``, ``overview.png`` and ``run.json`` in one step.

    ``knowledge`` is computed if not given.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    knowledge = knowledge or Knowledge.of(estimate)
    # Photographs that are in other processes have no digest here.
    key = "" if estimate.observed is None else capture_key(capture)
    with writing(folder, "entropy", RECORD, capture=key) as draft:
        write_maps(estimate, draft.folder)
        if pictures:
            write_overview(capture, estimate, draft.folder / "overview.png", knowledge)
        record = run_record(capture, estimate, knowledge)
        write_run(draft, record, run or Run())

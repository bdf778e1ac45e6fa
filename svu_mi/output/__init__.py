"""Results as files: maps, an overview, and the record of the run."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from svu_mi.errors import OutputError
from svu_mi.output.manifest import environment_record as environment_record
from svu_mi.output.manifest import run_record as run_record
from svu_mi.output.manifest import write_manifest as write_manifest
from svu_mi.output.maps import write_maps as write_maps
from svu_mi.output.overview import write_overview as write_overview


def prepare_folder(folder: str | Path) -> Path:
    """Make a folder for results and check that files can be written there.

    Worth calling before a long run: it fails in a millisecond.

    Raises:
        OutputError: it cannot be made, is a file, or is not writable.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise OutputError(f"{folder}: is a file, not a folder; choose another folder.") from error
    except OSError as error:
        raise OutputError(
            f"{folder}: the folder cannot be made ({error.strerror}); choose another folder."
        ) from error
    try:
        # Permissions do not tell: root, read-only mounts and quotas are known by trying.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise OutputError(
            f"{folder}: no file can be written there ({error.strerror}); choose another "
            "folder, or change its permissions."
        ) from error
    return folder


def write_outputs(
    capture: Any,
    estimate: Any,
    folder: str | Path,
    *,
    settings: Mapping[str, Any] | None = None,
    kernels: Mapping[str, int] | None = None,
) -> None:
    """Write ``entropy.exr``, ``coverage.exr``, ``overview.png`` and ``run.json``.

    Each file replaces an older one only when it is complete. ``run.json`` comes last, so a
    folder that has it has everything.

    Args:
        capture: the ``Capture``.
        estimate: its ``Estimate``.
        folder: made if missing.
        settings: what the caller was asked for (command-line options, seeds).
        kernels: number of kernels compiled per stage, ``Progress.kernels``.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    folder = prepare_folder(folder)
    (folder / "run.json").unlink(missing_ok=True)  # of an older run
    write_maps(estimate, folder)
    write_overview(capture, estimate, folder / "overview.png")
    record = run_record(capture, estimate)
    record["settings"]["given"] = settings
    record["kernels_compiled"] = kernels
    write_manifest(folder / "run.json", {**record, "environment": environment_record()})

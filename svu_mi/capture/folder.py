"""The capture folder: ``capture.json`` beside ``view_0000.exr``, ..."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from svu_mi.capture.poses import describe, make_sensor
from svu_mi.capture.scene import check_sensor
from svu_mi.errors import CaptureError, excerpt
from svu_mi.files import read_json, write_json

FILE = "capture.json"
FORMAT = "svu-capture"
VERSION = 1


@dataclass(frozen=True, kw_only=True)
class Description:
    """What ``capture.json`` says.

    Attributes:
        scene: path of the Mitsuba scene, None when the capture was made from a live scene.
        defines: the scene's ``-D`` parameters.
        shape: id of the target, None = the only candidate.
        exposures: one gain per view, empty = all 1.
        sensors: descriptions of the sensors, empty = those of the scene.
        imported: what it was imported from, and how; empty = it was not.
    """

    scene: Path | None = None
    defines: Mapping[str, str] = field(default_factory=dict)
    shape: str | None = None
    exposures: Sequence[float] = ()
    sensors: Sequence[Mapping[str, Any]] = ()
    imported: Mapping[str, Any] = field(default_factory=dict)

    def make_sensors(self, path: Path) -> tuple[Any, ...]:
        """Make the sensors that the photographs of this folder were taken with."""
        made = []
        for index, record in enumerate(self.sensors):
            label = f"{path}: sensor {index}"
            made.append(make_sensor(record, label))
            check_sensor(made[-1], label)
        return tuple(made)


def read(folder: Path) -> Description | None:
    """Read ``capture.json``; None where the folder has none.

    Raises:
        CaptureError: the file is not JSON or not a capture.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    record = read_json(path)
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise CaptureError(f'{path}: not a capture; expected "format": "{FORMAT}".')
    if record.get("version", VERSION) != VERSION:
        raise CaptureError(
            f"{path}: version {excerpt(record['version'])} is not known, only {VERSION}; update "
            "svu_mi."
        )
    try:
        scene = record.get("scene")
        return Description(
            scene=None if scene is None else (folder / scene).resolve(),
            defines={str(k): str(v) for k, v in record.get("define", {}).items()},
            shape=record.get("shape"),
            exposures=tuple(float(gain) for gain in record.get("exposure", ())),
            sensors=tuple(record.get("sensors", ())),
            imported=dict(record.get("import", {})),
        )
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise CaptureError(f"{path}: a value has the wrong type ({excerpt(error)}).") from error
    except (OSError, RuntimeError) as error:  # a link to itself
        raise CaptureError(f"{path}: the scene cannot be found ({excerpt(error)}).") from error


def write(folder: Path, description: Description, sensors: Sequence[Any]) -> None:
    """Write ``capture.json`` (atomically); the scene's path is kept relative if it can be."""
    scene = description.scene
    record = {
        "format": FORMAT,
        "version": VERSION,
        "scene": None if scene is None else os.path.relpath(scene.resolve(), folder.resolve()),
        "define": dict(description.defines),
        "shape": description.shape,
        "exposure": list(description.exposures),
        "sensors": [describe(sensor) for sensor in sensors],
        **({"import": description.imported} if description.imported else {}),
    }
    write_json(folder / FILE, record)

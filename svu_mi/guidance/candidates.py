"""Candidate views for the next photograph."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture import capture_folder
from svu_mi.capture.capture import Capture
from svu_mi.capture.importers.nerf import read_transforms
from svu_mi.capture.importers.resampling import square_pixel_frame
from svu_mi.capture.scene import check_sensor, find_sensors, load_scene
from svu_mi.capture.sensors import sensors_like
from svu_mi.core.checked_arguments import checked
from svu_mi.core.io.files import read_json
from svu_mi.core.validation import indices_of
from svu_mi.errors import CaptureError, OptionError, ShapeError


@dataclass(frozen=True, repr=False)
class Candidates:
    """Candidate views for the next photograph.

    Attributes:
        sensors: C perspective sensors.
        names: C labels.
        reachable: (C,) bool; False where no camera can be placed.

    Raises:
        OptionError: no candidate is reachable.
        ShapeError: the numbers of sensors, names and flags differ.
        SceneError: a sensor is not a pinhole, or its pose is mirrored.

    Example:
        >>> views = svu.Candidates.around(capture, 50, lowest=0.0)
        >>> views.count
        50
        >>> svu.Candidates.at(capture, [0, 5]).count
        2
    """

    sensors: tuple[Any, ...]
    names: tuple[str, ...]
    reachable: np.ndarray

    def __post_init__(self) -> None:
        reachable = np.asarray(self.reachable, bool)
        object.__setattr__(self, "reachable", reachable)
        if len(self.names) != self.count or reachable.shape != (self.count,):
            raise ShapeError(
                f"Candidates: {self.count} sensors, but {len(self.names)} names and flags of "
                f"shape {reachable.shape}."
            )
        if not reachable.any():
            raise OptionError("Candidates: no candidate is reachable; add a reachable one.")
        for sensor, name in zip(self.sensors, self.names, strict=True):
            check_sensor(sensor, f"Candidate '{name}'")

    def __repr__(self) -> str:
        return f"<Candidates: {self.reachable.sum()} of {self.count} reachable>"

    @property
    def count(self) -> int:
        """Number of candidates C."""
        return len(self.sensors)

    @staticmethod
    @checked
    def of(sensors: Sequence[Any]) -> "Candidates":
        """Return candidates from Mitsuba sensors; all are reachable."""
        names = tuple(sensor.id() or f"candidate_{i:04d}" for i, sensor in enumerate(sensors))
        return Candidates(tuple(sensors), names, np.ones(len(sensors), bool))

    @staticmethod
    @checked
    def without_photograph(capture: Capture) -> "Candidates":
        """Return the sensors of a capture that have no photograph in use.

        Raises:
            OptionError: every sensor has a photograph.
        """
        left = [i for i, used in enumerate(capture.used) if not used]
        if not left:
            raise OptionError(
                "Every sensor of the capture has a photograph; place candidates with "
                "Candidates.around(capture).",
                shell="Every sensor of the capture has a photograph; give --candidates a number "
                "of views to place, such as 100.",
            )
        return Candidates.at(capture, left)

    @staticmethod
    @checked
    def at(capture: Capture, views: Sequence[int] | Sequence[bool]) -> "Candidates":
        """Return the sensors of a capture with indices (or flags) ``views``; all are reachable."""
        chosen = indices_of(views, capture.count, "Candidates.at()", "view")
        sensors = tuple(capture.sensors[view] for view in chosen)
        names = tuple(capture.names[view] for view in chosen)
        return Candidates(sensors, names, np.ones(len(sensors), bool))

    @staticmethod
    @checked
    def around(
        capture: Capture, count: int = 100, *, up: tuple[float, float, float] | None = None,
        lowest: float = -1.0, distance: float | None = None,
    ) -> "Candidates":  # fmt: skip
        """Place candidates on a sphere around the object, with the photographs' camera.

        Args:
            capture: Capture whose first photograph defines film size and lens.
            count: Number of candidates.
            up: Upward direction, towards the top of the sphere; default: that of the cameras.
            lowest: Sine of the lowest elevation: -1 for the sphere, 0 for the upper hemisphere.
            distance: Distance to the object's centre, in scene units; default: the median of the
                photographs.

        Raises:
            OptionError: a number is out of range, or ``capture`` is not a ``Capture``.
        """
        used = capture.used_sensors or capture.sensors
        sensors = sensors_like(used, capture.shape, count, distance=distance, up=up, lowest=lowest)
        return Candidates.of(sensors)

    @staticmethod
    @checked
    def read(path: str | Path) -> "Candidates":
        """Read candidates from a file.

        Args:
            path: Path of ``transforms.json``, of ``capture.json`` (or its folder), or of a
                Mitsuba XML file with sensors.

        Raises:
            CaptureError: the file is missing, or has another format.
            SceneError: Mitsuba cannot load the file, or it contains no sensor.
        """
        path = Path(path)
        if path.is_dir():
            path = path / capture_folder.FILE
        if not path.is_file():
            raise CaptureError(f"{path}: no such file; give poses as JSON or Mitsuba XML.")
        if path.suffix.lower() == ".xml":
            return Candidates.of(find_sensors(load_scene(path), str(path)))
        record = read_json(path)
        is_object = isinstance(record, dict) and path.name == capture_folder.FILE
        if is_object and record.get("format") == capture_folder.FORMAT:
            description = capture_folder.read(path.parent)
            assert description is not None
            return Candidates.of(description.make_sensors(path))
        frames = (square_pixel_frame(frame)[0] for frame in read_transforms(path).frames)
        return Candidates.of([frame.sensor() for frame in frames])

    def restricted(self, reachable: Any) -> "Candidates":
        """Return the candidates with some marked as unreachable.

        Args:
            reachable: (C,) bool flags, combined with the existing ones by "and".

        Raises:
            ShapeError: the number of flags differs from C.
            OptionError: flags are not bool, or no candidate remains.
        """
        flags = np.asarray(reachable).ravel()
        if flags.dtype != bool:
            raise OptionError(
                "Candidates.restricted(): reachable must be bool flags, one per candidate."
            )
        if flags.shape != (self.count,):
            raise ShapeError(
                f"Candidates: {flags.size} flags for {self.count} candidates; give one per "
                "candidate."
            )
        return replace(self, reachable=self.reachable & flags)


def candidates_or_default(given: Candidates | Sequence[Any] | None, capture: Capture) -> Candidates:
    """Return ``given`` as candidates; if None, sensors without a photograph, or a sphere."""
    if isinstance(given, Candidates):
        return given
    if given is not None:
        return Candidates.of(given)
    unused = [view for view, used in enumerate(capture.used) if not used]
    missing = [view for view in unused if not np.isfinite(capture.images[view]).any()]
    return Candidates.at(capture, missing) if missing else Candidates.around(capture)

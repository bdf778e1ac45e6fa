"""Capture folders: ``capture.json`` and photographs ``view_0000.exr``, ..."""

import math
import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from svu_mi.capture.capture import Capture, Flash
from svu_mi.capture.scene import check_sensor, find_sensors, to_world
from svu_mi.capture.sensors import LARGEST, changed_sensor, describe, make_sensor
from svu_mi.core.io.exr import read_header
from svu_mi.core.io.files import is_temporary, read_json, refusing, write_json
from svu_mi.core.io.folder_exchange import restore
from svu_mi.core.io.output_folder import Claim, Draft, is_kept, writing
from svu_mi.core.io.provenance import RESULT, RUN, Entry, entry_of
from svu_mi.core.io.schema import NAMES, NUMBER, OBJECT, SIMPLE, TEXT, WHOLE, Axis, Field, checked
from svu_mi.core.validation import MAX_VIEWS
from svu_mi.errors import CaptureError

FILE = "capture.json"
FORMAT = "svu-capture"
VERSION = 1
FLASH = {"position": Field(NUMBER, (3,), -LARGEST, LARGEST),
         "intensity": Field(NUMBER, (3,), 1 / LARGEST, LARGEST)}  # fmt: skip
CAPTURE = {
    "version": Field(WHOLE, (), VERSION, VERSION, default=VERSION),
    "scene": Field(TEXT, default=None), "shape": Field(TEXT, default=None),
    "define": Field(SIMPLE, (NAMES,), -LARGEST, LARGEST, default={}),
    "exposure": Field(NUMBER, (Axis("gains", 0, MAX_VIEWS),), 1 / LARGEST, LARGEST, default=()),
    "sensors": Field(OBJECT, (Axis("cameras", 0, MAX_VIEWS),), default=()),
    "flash": Field(FLASH, default=None),
    "import": Field(OBJECT, default={}), "rendered": Field(OBJECT, default={}),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Description:
    """Content of ``capture.json``.

    Attributes:
        scene: Path of the Mitsuba scene; None for a scene that was not loaded from a file.
        defines: Values of the scene's ``-D`` parameters.
        shape: Name of the target (``load_capture``); None selects the only candidate.
        exposures: One gain per view; empty if unknown.
        sensors: Descriptions of the sensors; empty selects the scene's sensors.
        flash: Lamp fixed to the camera; None without one.
        imported: Source and options of the import; empty if not imported.
        rendered: Render settings ``spp`` and ``seed``; empty if not rendered.
        run: Id of the run that wrote the file; empty if unknown.
    """

    scene: Path | None = None
    defines: Mapping[str, str] = field(default_factory=dict)
    shape: str | None = None
    exposures: Sequence[float] = ()
    sensors: Sequence[Mapping[str, Any]] = ()
    flash: Flash | None = None
    imported: Mapping[str, Any] = field(default_factory=dict)
    rendered: Mapping[str, Any] = field(default_factory=dict)
    run: str = ""

    def overridden(self, shape: str | None, defines: Mapping[str, str] | None) -> Self:
        """Return a copy in which arguments replace target and values of ``capture.json``."""
        return replace(
            self, shape=self.shape if shape is None else shape,
            defines={**self.defines, **(defines or {})},
        )  # fmt: skip

    @property
    def photographs(self) -> list[str]:
        """Names of the imported photographs, one per view; empty if unknown.

        File names only, or full paths if file names are not unique.
        """
        paths = self.imported.get("photographs", ())
        if not (isinstance(paths, list | tuple) and all(isinstance(path, str) for path in paths)):
            return []
        names = [path.rpartition("/")[2] for path in paths]
        return names if len(set(names)) == len(names) and all(names) else list(paths)

    @property
    def mesh_scale(self) -> float | None:
        """Scale that the mesh was imported with; None if the capture was not imported."""
        scale = self.imported.get("mesh_scale", 1.0)
        is_valid = isinstance(scale, float) and 0 < scale < math.inf
        return (scale if is_valid else 1.0) if self.imported else None

    def make_sensors(self, path: Path) -> tuple[Any, ...]:
        """Make the described sensors; ``path`` is the folder, for messages."""
        made = []
        for index, record in enumerate(self.sensors):
            label = f"{path / FILE}: sensor {index}"
            made.append(make_sensor(record, label))
            check_sensor(made[-1], label)
        return tuple(made)


def read(folder: Path) -> Description | None:
    """Read the ``capture.json`` of a folder; return None if it does not exist."""
    restore(folder)
    path = folder / FILE
    if not path.is_file():
        return None
    record = read_json(path)
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise CaptureError(f'{path}: not a capture; expected "format": "{FORMAT}".')
    with refusing(path, "render or import it again"):
        values = checked(record, CAPTURE)
    scene = None if values["scene"] is None else folder / values["scene"]
    with refusing(f"{path}: scene", "correct its path"):  # a circular link, a name too long
        scene = None if scene is None else Path(os.path.realpath(scene))
        _ = scene is None or scene.is_file()
    written, flash = Entry.parse(record.get(RESULT)), values["flash"]
    return Description(
        scene=scene,
        defines={key: str(value) for key, value in values["define"].items()},
        shape=values["shape"],
        exposures=tuple(values["exposure"]),
        sensors=tuple(values["sensors"]),
        flash=flash and Flash(*(tuple(map(float, flash[name])) for name in FLASH)),  # type: ignore[arg-type]
        imported=values["import"],
        rendered=values["rendered"],
        run=written.run if written else "",
    )


def require_one_run(folder: Path, runs: Mapping[Path, str], run: str) -> None:
    """Raise if files come from another run or were replaced while being read.

    An empty run id is unknown and never causes an error.
    """
    if run and ((entry := entry_of(folder / FILE)) is None or entry.run != run):
        raise CaptureError(f"{folder}: changed while it was being read; load it again.")
    for path, other in runs.items():
        if run and other and other != run:
            raise CaptureError(
                f"{path}: written by another run than the {FILE} in its folder; restore the "
                "original photograph, or render or import the capture again."
            )


def write(draft: Draft, description: Description, sensors: Sequence[Any]) -> None:
    """Write ``capture.json``, which completes a draft folder."""
    scene, target = description.scene, draft.target.resolve()
    if scene is not None and scene.resolve().is_relative_to(draft.folder.resolve()):
        scene = draft.target / scene.resolve().relative_to(draft.folder.resolve())
    record = {
        "format": FORMAT,
        "version": VERSION,
        "scene": None if scene is None else os.path.relpath(scene.resolve(), target),
        "define": dict(description.defines),
        "shape": description.shape,
        "exposure": list(description.exposures),
        "sensors": [describe(sensor) for sensor in sensors],
        **({} if description.flash is None else {"flash": asdict(description.flash)}),
        **({"import": description.imported} if description.imported else {}),
        **({"rendered": description.rendered} if description.rendered else {}),
        **draft.entries(),
    }
    write_json(draft.folder / FILE, record)


def write_copy(folder: Path, changed: Capture, place: Claim) -> None:
    """Write a copy of a capture folder with the poses of ``changed``, the same capture."""
    description = read(folder)
    assert description is not None
    own = description.make_sensors(folder) or find_sensors(changed.scene, str(folder))
    sensors = [
        changed_sensor(old, to_world=to_world(new).tolist())
        for old, new in zip(own, changed.sensors, strict=True)
    ]
    # The copy must name the run that wrote the photographs.
    runs = (read_header(path).attributes.get(RUN) for path in sorted(folder.glob("*.exr")))
    run = description.run or str(next(filter(None, runs), ""))
    with writing(place, place.command, FILE, run=run) as draft:
        for path in sorted(folder.iterdir()):
            if not (path.name.startswith(".") or is_kept(path.name) or path.name == FILE):
                copy = shutil.copytree if path.is_dir() else shutil.copyfile
                copy(path, draft.folder / path.name)
        scene = description.scene
        if scene is not None and scene.is_relative_to(folder.resolve()):
            scene = draft.folder.resolve() / scene.relative_to(folder.resolve())
        write(draft, replace(description, scene=scene), sensors)


def stamps(places: Iterable[Path], skip: Callable[[Path], bool]) -> list[tuple[str, int, int]]:
    """Return path, size and modification time of each input file.

    Folders are searched recursively, except those for which ``skip`` returns True.
    """
    stamped = []
    for place in places:
        files = [place]
        for folder, inner, names in os.walk(place):
            inner[:] = [name for name in inner if not skip(Path(folder, name))]
            files += [Path(folder, name) for name in names]
        for path in sorted(files):
            parts = path.relative_to(place).parts
            if path.is_file() and not any(is_temporary(n) or is_kept(n) for n in parts):
                status = path.stat()
                stamped.append((str(path), status.st_size, status.st_mtime_ns))
    return stamped

"""Fuzzed files that svu writes and reads back: records, checkpoints, caches."""

from __future__ import annotations

import io
import logging
import os
import random
import shutil
import tempfile
import warnings
import zipfile
from pathlib import Path

import numpy as np

from support import mutations
from support.fuzz_formats import Format, capture, write_scene_capture
from support.helpers import made_up_light
from support.mutations import BINARY, LARGEST
from svu_mi.calibration.light.light_folder import load_light, save_light
from svu_mi.capture import capture_folder
from svu_mi.cli.batch.runner import _figures_of
from svu_mi.cli.batch.steps import read_done, write_done
from svu_mi.core.io.files import write_json, write_text
from svu_mi.core.io.npz import DIGEST, write_arrays
from svu_mi.core.io.output_folder import claimed, writing
from svu_mi.core.io.provenance import entry_of, marks_of, mesh_of
from svu_mi.errors import SvuError, SvuWarning
from svu_mi.evaluation import reference_cache
from svu_mi.evaluation.reference import TracedTables
from svu_mi.evaluation.reference_options import ReferenceOptions
from svu_mi.output.result_maps import read_result as read_maps
from svu_mi.output.run_record import RECORD
from svu_mi.output.texture_files import FILES, read_textures, recovery_settings, write_textures
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.recovery.checkpoint import Checkpoint, DescentState
from svu_mi.recovery.svbrdf_textures import Textures

SETTINGS = {"seed": 3, "sh": {"descent": {"steps": 9, "rate": 0.01}, "name": "ball"}, "tv": None}
CONTENT = {"shapes": "ab" * 16, "light": "cd" * 16, "photographs": "ef" * 16}
MAPS = {"base_color": (4, 6, 3), "roughness": (4, 6, 1), "metallic": (4, 6, 1)}
SHAPES = {"base_color": (4, 6, 3), "roughness": (4, 6, 1)}
OPTIONS = ReferenceOptions(2, PrincipledGrid(2, 2, 2), 0.5, 2, "linear", 0)
logging.getLogger("svu_mi.core.io").setLevel(logging.ERROR)  # says what it keeps
REFERENCE = f"reference-{'0a' * 16}.npz"


def _checkpoint(folder: Path) -> Checkpoint:
    return Checkpoint(folder / "checkpoint.npz", SETTINGS, content=CONTENT, resume=True)


def write_checkpoint(folder: Path) -> None:
    rng = np.random.default_rng(812)
    values = {name: rng.random(shape, np.float32) for name, shape in SHAPES.items()}
    flat = {name: value.ravel() for name, value in values.items()}
    losses = rng.random(4, np.float32)
    _checkpoint(folder).save(
        DescentState(step=4, values=values, first=flat, second=flat, losses=losses)
    )


def read_checkpoint(folder: Path, out: Path) -> None:
    state = _checkpoint(folder).load(SHAPES)
    assert state is None or len(state.losses) == state.step


def write_reference(folder: Path) -> None:
    traced = TracedTables(
        subset=np.array([4, 7, 9]), tables=np.random.default_rng(813).random((3, 3, 2, 2, 2)),
        coverage=np.array([2, 0, 1]), brightness=np.ones(3), scale=1.0, unit=1.0, seconds=2.0,
        rays=10, dropped=0,
    )  # fmt: skip
    reference_cache.store(folder / REFERENCE, traced)


def read_reference(folder: Path, out: Path) -> None:
    """Read a reference; the warning that it is made again is what the user sees."""
    with warnings.catch_warnings(action="error", category=SvuWarning):
        try:
            reference = reference_cache.load(folder / REFERENCE, OPTIONS)
        except SvuWarning as warning:
            raise SvuError(str(warning)) from warning
    assert reference is None or reference.entropy.shape == reference.subset.shape


def write_result(folder: str | os.PathLike[str]) -> None:
    """Write a result with files in it, as ``svu`` does."""
    with writing(folder, "recover", "run.json", capture="ab" * 16) as draft:
        (draft.folder / "assets").mkdir()
        for name in ("losses.csv", "assets/mesh.ply"):
            write_text(draft.folder / name, name)
        write_json(draft.folder / "run.json", {"svu_mi": "1.0", "texels": 12, **draft.entries()})


def read_result(folder: Path, out: Path) -> None:
    """Write another result over one; no file that it does not own is lost."""
    entry = entry_of(folder / "run.json")
    target = out / "result"
    for name in ("result", "result.before"):
        shutil.rmtree(out / name, ignore_errors=True)
    if (folder / "run.json").is_file():
        (target / "assets").mkdir(parents=True)
        for name in ("losses.csv", "assets/mesh.ply", "run.json"):
            shutil.copy(folder / name, target / name)
        (target / "others.txt").write_text("")
        with warnings.catch_warnings(), claimed(target, "recover", overwrite=True) as place:
            warnings.simplefilter("ignore", SvuWarning)
            write_result(place)
        assert (out / "result.before" / "others.txt").is_file()
    if entry is None:
        raise SvuError(f"{folder}: there is no result.")


def write_found_light(folder: Path) -> None:
    save_light(made_up_light(), folder)


def read_found_light(folder: Path, out: Path) -> None:
    light = load_light(folder)
    for image in (light.radiance, light.sd, light.known):
        assert np.isfinite(image).all()
    assert light.radiance.min() >= 0 and 0 <= light.known_part <= 1
    save_light(light, out / "again")  # all of it can be written


def write_recovered(folder: Path) -> None:
    """Write textures with their record, as ``svu recover`` does."""
    rng = np.random.default_rng(814)
    images = {name: rng.random((*shape[:2], shape[2]), np.float32) for name, shape in MAPS.items()}
    with writing(folder, "recover", RECORD, capture="ab" * 16) as draft:
        write_textures(Textures.of(images), draft.folder)
        used = {"settings": {"used": SETTINGS}, "inputs": {"mesh": "cd" * 16, "source": "vase"}}
        write_json(draft.folder / RECORD, {**used, **draft.entries()})


def read_recovered(folder: Path, out: Path) -> None:
    """Read textures, their settings and their mesh, and compare them as maps."""
    textures = read_textures(folder)
    assert all(
        0 <= np.min(image) <= np.max(image) <= 1 for image in map(np.array, textures.values())
    )
    assert isinstance(recovery_settings(folder), dict)
    assert isinstance(mesh_of(folder / RECORD, marks_of(folder / FILES["roughness"])[0]), str)
    read_maps(folder, "fuzzed")


def write_batch(folder: Path) -> None:
    """Write the records of two steps, and the figures of one, as ``svu batch`` does."""
    write_done(folder, {"entropy": {"key": "ab" * 16, "seconds": 2.5, "peak_bytes": 3 * 10**8}})
    (folder / "entropy").mkdir()
    intervals = {"seen_part": 0.9, "all_known_part": 0.2}
    result = {"mean_entropy_of_seen": 0.4, "intervals": intervals}
    write_json(folder / "entropy" / RECORD, {"result": result})


def read_batch(folder: Path, out: Path) -> None:
    """Read the records of a batch; what is damaged is computed again."""
    done, figures = read_done(folder), _figures_of(folder)
    assert all(0 <= value <= 1 for value in figures.values())
    assert all(step["seconds"] >= 0 and step["peak_bytes"] >= 0 for step in done.values())
    if not (done and figures):
        raise SvuError(f"{folder}: a step is computed again.")


def rebuilt_npz(data: bytes, draw: random.Random) -> bytes:
    """Change the arrays of an archive by their structure, mostly with the right digest."""
    try:
        with np.load(io.BytesIO(data)) as archive:
            arrays = {name: archive[name] for name in archive.files if name != DIGEST}
    except Exception as error:  # damaged already, in any way
        raise ValueError from error
    if not arrays:
        return data
    name = draw.choice(sorted(arrays))
    array = arrays[name]
    match draw.randrange(9):
        case 0:
            del arrays[name]
        case 1:
            arrays[draw.choice(["other", "values/other", "first/other", "/", "values/"])] = array
        case 2:
            arrays[name] = array.reshape(-1)[: draw.randrange(array.size + 1)]
        case 3:
            arrays[name] = np.stack([array] * draw.choice((1, 2, 9)))
        case 4:
            arrays[name] = np.array(draw.choice(["", "text", "[1]", "[" * 50_000, '{"a": NaN}']))
        case 5 if array.dtype.kind == "f" and array.size:
            arrays[name] = array.copy()
            value = draw.choice([np.nan, np.inf, -np.inf, -1, 1e30, -0.0])
            with np.errstate(over="ignore"):  # half floats
                arrays[name].flat[draw.randrange(array.size)] = value
        case 6 if array.dtype.kind == "U":
            arrays[name] = np.array(mutations.retyped(str(array).encode(), draw)[:LARGEST].decode())
        case 7:
            arrays[name] = np.array(draw.choice([-1, 10**9, 2**62, 0, True, 1.5, 1j, b"x"]))
        case _:
            kinds = ("f2", "f4", "f8", ">f4", "i4", "u8", "c8")
            arrays[name] = np.zeros(array.shape, draw.choice(kinds))
    return _archive(arrays, draw)


def _archive(arrays: dict[str, np.ndarray], draw: random.Random) -> bytes:
    """Return an archive as svu writes it, or now and then packed or with headers that lie."""
    stream = io.BytesIO()
    kind = draw.randrange(12)
    if kind == 0:
        np.savez_compressed(stream, **(arrays | {"zeros": np.zeros(2**20)}))  # 8 MiB in 8 KiB
        return stream.getvalue()
    if kind == 1:
        with zipfile.ZipFile(stream, "w") as archive:
            for name, array in arrays.items():
                member = io.BytesIO()
                np.save(member, array)
                shape = draw.choice([b"(99999999999,), }", b"(-1,), }", b"(2, 2**9), }"])
                old = str(array.shape).encode() + b", }"
                told = member.getvalue().replace(old, shape[: len(old)].ljust(len(old)))
                archive.writestr(f"{name}.npy", told)
        return stream.getvalue()
    with tempfile.TemporaryDirectory() as folder:
        write_arrays(Path(folder, "a.npz"), arrays)
        return Path(folder, "a.npz").read_bytes()


mutations.BY_SUFFIX[".npz"] = (*BINARY, *[rebuilt_npz] * 8)

RECORDS = (
    Format(name="checkpoint", make=write_checkpoint, read=read_checkpoint),
    Format(name="light", make=write_found_light, read=read_found_light, share=3),
    Format(name="reference", make=write_reference, read=read_reference, share=2),
    Format(name="recovered", make=write_recovered, read=read_recovered, share=2),
    Format(name="batch.json", make=write_batch, read=read_batch, share=2),
    Format(name="run.json", make=write_result, read=read_result, targets="run.json", share=4),
    Format(
        name="capture.json", make=write_scene_capture, read=capture, targets=capture_folder.FILE,
        share=4,
    ),
)  # fmt: skip

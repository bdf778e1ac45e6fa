"""Differences between two results about one object, as maps and numbers.

svu.compare("before", "after")                      # captures: both are estimated
svu.compare("out/textures", "painted")              # a recovery, and other textures
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from PIL import Image

from svu_mi.calibration.light.resolve_light import illuminated
from svu_mi.capture import capture_folder
from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import mesh_key
from svu_mi.capture.crop import Detail
from svu_mi.capture.loading import plan_capture
from svu_mi.capture.mesh import make, read_ply
from svu_mi.core.io.files import read_json
from svu_mi.core.io.folder_exchange import restore
from svu_mi.core.io.provenance import text_in
from svu_mi.core.progress import Progress
from svu_mi.core.validation import require_texels
from svu_mi.errors import CaptureError, OptionError
from svu_mi.evaluation.image_metrics import psnr
from svu_mi.geometry.texels import size_of, texels
from svu_mi.output.estimate_arrays import label_of
from svu_mi.output.interval_summary import area_share, plain_percent, weighted_median
from svu_mi.output.maps import COVERAGE, ENTROPY, read_deviations, read_map
from svu_mi.output.run_record import RECORD
from svu_mi.output.texture_files import MESH, find_textures, read_texture
from svu_mi.parameters import NAMES
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.presets import preset as find_preset
from svu_mi.recovery.recover import Recovery

Source = str | Path | Capture | Estimate | Recovery

TOLERANCE = 0.05  # relevant difference where no standard deviation is known
RESOLUTION = 512  # texels per side if both sides are captures
CERTAIN = 2.0  # standard deviations
AROUND = 5  # texels, side of the square over which differences are averaged
LEAST = 1e-3  # lower bound of standard deviations, and of the weight of a resampled texel


@dataclass(frozen=True, kw_only=True)
class Side:
    """Maps (H, W, C) of one side by parameter, and ``entropy``, each of its own size.

    ``seen`` (H, W) are the texels in photographs, ``key`` is the digest of the mesh.
    """

    name: str
    about: str
    maps: Mapping[str, np.ndarray]
    sd: Mapping[str, np.ndarray] = field(default_factory=dict)
    seen: np.ndarray | None = None
    mesh: Any | None = None
    key: str = ""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Difference of two maps; all are NaN where one side has no value.

    Attributes:
        both: (H, W, C) float32, the first and the second.
        values: (H, W, C) float32, the second minus the first.
        deviations: (H, W, 1) float32, the same in standard deviations, averaged over the texels
            around, of the channel where it is largest; None where no deviation is known.
        figures: by area of the surface: ``mean`` over channels; ``median`` of the size in the
            channel that differs most; ``rms``; ``psnr`` in dB; ``beyond``, the part that differs
            by more than the tolerance; ``certain``, the part that certainly differs, and
            ``certain_mean``, the mean there; None where not known.
    """

    both: tuple[np.ndarray, np.ndarray]
    values: np.ndarray
    deviations: np.ndarray | None
    figures: Mapping[str, float | None]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Differences between two sides: the second minus the first.

    Attributes:
        sides: both, each with its maps.
        area: (H, W) of the surface in each texel; 0 outside the charts.
        seen: (H, W) bool, the texels that both show.
        maps: differences by parameter, and of ``entropy``, as far as both have them.
        tolerance: relevant difference where no standard deviation is known.
        seen_part: part of the surface that both show.
        notes: sentences on how it was compared.
    """

    sides: tuple[Side, Side]
    area: np.ndarray
    seen: np.ndarray
    maps: Mapping[str, Difference]
    tolerance: float
    seen_part: float
    notes: tuple[str, ...] = ()

    @property
    def differences(self) -> dict[str, Difference]:
        """Those of parameters."""
        return {name: one for name, one in self.maps.items() if name != "entropy"}

    @property
    def entropy(self) -> Difference | None:
        """That of the entropy, None where one is not known."""
        return self.maps.get("entropy")

    def image(self, name: str) -> np.ndarray:
        """Return a map (H, W), or (H, W, 3) for base colour; NaN where not both have a value.

        Args:
            name: a parameter, or ``entropy``; or a parameter and ``_deviations``: its difference
                in standard deviations.

        Raises:
            OptionError: there is no such map.
        """
        found = self.maps.get(name.removesuffix("_deviations"))
        image = None if found is None else found.values if name in self.maps else found.deviations
        if image is None:
            raise OptionError(f"Comparison.image(): there is no map {name!r}.")
        return image if image.shape[2] > 1 else image[..., 0]

    def sentence(self) -> str:
        """Return "Of the surface that both show, roughness differs certainly on 12 %, ..."."""
        told = []
        for name, one in self.differences.items():
            share, how, by = one.figures["certain"], "certainly", one.figures["certain_mean"]
            if share is None:
                share, how = one.figures["beyond"] or 0.0, f"by more than {self.tolerance:g}"
            by_mean = "" if by is None else f" (by {by:+.3f})"
            told.append(f"{label_of(name)} differs {how} on {plain_percent(share)}{by_mean}")
        if self.entropy is not None:
            told.append(f"the entropy differs by {self.entropy.figures['mean']:+.3f} in the mean")
        return f"Of the surface that both show, {', '.join(told)}."


def compare(
    a: Source,
    b: Source,
    *,
    preset: str | tuple[str, ...] = "default",
    resolution: int | tuple[int, int] | None = None,
    tolerance: float = TOLERANCE,
    trust: bool = False,
    progress: Progress | None = None,
    memory: float | None = None,
) -> Comparison:
    """Compare two results about one object.

    Each side is a capture, which is estimated; an ``Estimate``; a ``Recovery``; or a folder: a
    capture's, a result of ``svu entropy`` or ``svu recover``, or any with textures ``base_color``,
    ``roughness``, ``metallic`` (some of them, EXR or PNG, over the same UVs). An 8- or 16-bit
    base colour is decoded from sRGB. Maps of another size are resampled; texels that not both
    show are left out. Where standard deviations are known, a difference is certain if its mean
    over the texels around is more than twice the standard deviation of both together.

    Args:
        a: the first, such as before a change, or what was expected.
        b: the second, which the first is subtracted from.
        preset: of estimates of captures; one for both, or one for each.
        resolution: texels per side, or (width, height); by default that of the coarser textures,
            512 if there are none.
        tolerance: relevant difference where no standard deviation is known.
        trust: as of ``load_capture``, like ``memory``.
        progress: shows the stages.
        memory: bytes that photographs may take.

    Raises:
        CaptureError: they are not of one object, or have nothing in common; or as
            ``load_capture``.
        OptionError: an option out of range, or an unknown preset.
        MeshError: a mesh cannot carry texels.
    """
    plan = plan_comparison(a, b, preset=preset, resolution=resolution, tolerance=tolerance)
    stages = progress or Progress()
    for index, source in plan.captures:
        if not isinstance(source, Capture):
            with stages.stage("Loading the capture"):
                detail = Detail(texels=plan.size)
                planned = plan_capture(source, trust=trust, light="optional", detail=detail)
                source = planned.read(memory)
        plan.estimate(index, source, stages)
    return plan.compared()


@dataclass(frozen=True)
class ComparisonPlan:
    """A comparison of two sides, which are None for captures that must be estimated first."""

    sources: tuple[Source, Source]
    names: list[str]
    presets: tuple[str, ...]
    sides: list[Side | None]
    size: tuple[int, int]
    tolerance: float

    @property
    def captures(self) -> list[tuple[int, Any]]:
        """Numbers and sources of the sides to estimate."""
        return [(k, self.sources[k]) for k, side in enumerate(self.sides) if side is None]

    def estimate(self, index: int, capture: Capture, progress: Progress) -> None:
        """Estimate a side; a light is found for a capture on disk that has none."""
        if not isinstance(self.sources[index], Capture):
            capture = illuminated(capture, progress=progress)
        preset, grid = self.presets[index], texels(capture.mesh, self.size)
        found = estimate(capture, grid, preset=preset, progress=progress)
        about = f"a capture, estimated with the preset {preset}"
        self.sides[index] = _of_estimate(found, self.names[index], about)

    def compared(self) -> Comparison:
        """Compare both sides."""
        first, second = self.sides
        assert first is not None and second is not None
        return _compared(first, second, self.size, self.tolerance)


def plan_comparison(
    a: Source, b: Source, *, preset: Any, resolution: Any, tolerance: Any
) -> ComparisonPlan:
    """Check the options and read results, but no capture (see ``compare``)."""
    both = (preset, preset) if isinstance(preset, str) else preset
    pair = isinstance(both, tuple | list) and len(both) == 2
    if not (pair and all(isinstance(name, str) for name in both)):
        raise OptionError(
            f"compare(): preset takes the name of one preset, or two for a and b, got {preset!r}.",
            shell="--preset takes one preset, or two for A and B.",
        )
    number = isinstance(tolerance, Real) and not isinstance(tolerance, bool)
    if not (number and 0 <= tolerance < np.inf):
        raise OptionError(
            f"compare(): tolerance must be a number, 0 or more, got {tolerance!r}.",
            shell=f"--tolerance must be 0 or more, got {tolerance:g}." if number else None,
        )
    size = None if resolution is None else size_of(resolution)
    if size is not None:
        require_texels(size, "compare(): resolution")
    presets = tuple(find_preset(name, method="angular").name for name in both)
    named = ((a, "the first"), (b, "the second"))
    names = [str(source) if isinstance(source, str | Path) else word for source, word in named]
    if names[0] == names[1]:
        names = [f"{name} ({chosen})" for name, chosen in zip(names, presets, strict=True)]
    sides = [_read(source, name) for source, name in zip((a, b), names, strict=True)]
    shapes = [max(image.shape[:2] for image in side.maps.values()) for side in sides if side]
    size = size or min(((w, h) for h, w in shapes), default=(RESOLUTION, RESOLUTION))
    return ComparisonPlan((a, b), names, presets, sides, size, tolerance)


def _read(source: Source, name: str) -> Side | None:
    """Return a side that is a result; None for a capture, which must be estimated."""
    if isinstance(source, Capture):
        return None
    if isinstance(source, Estimate):
        return _of_estimate(source, name, "an estimate")
    if isinstance(source, Recovery):
        known = Side(name=name, about="", maps={})
        if source.estimate is not None:
            known = _of_estimate(source.estimate, name, "")
        maps = {**known.maps, **{key: np.array(x) for key, x in source.textures.items()}}
        seen = source.image("coverage") > 0
        return replace(known, about="recovered textures", maps=maps, seen=seen)
    if not isinstance(source, str | Path):
        raise OptionError(
            "compare() takes captures, estimates, recoveries and folders, got a "
            f"{type(source).__name__}."
        )
    path = Path(source)
    restore(path)
    if path.suffix.lower() == ".xml" or (path / capture_folder.FILE).is_file():
        return None
    return _of_folder(path, name)


def _of_estimate(found: Estimate, name: str, about: str) -> Side:
    """Return means and standard deviations of an estimate's posterior."""
    if found.observed is None:
        raise OptionError(f"{name} does not know its capture; compare what estimate() returns.")
    means, sd = ({parameter: np.atleast_3d(found.image(f"{parameter}_{kind}"))
                  for parameter in found.posterior.axes} for kind in ("mean", "sd"))  # fmt: skip
    mesh = found.observed.capture.mesh
    return Side(
        name=name, about=about, maps=means | {"entropy": np.atleast_3d(found.image("entropy"))},
        sd=sd, seen=found.image("coverage") > 0, mesh=mesh, key=mesh_key(mesh),
    )  # fmt: skip


def _of_folder(path: Path, name: str) -> Side:
    """Read a result of ``svu entropy`` or ``svu recover``, or any folder of textures."""
    if not path.is_dir():
        raise CaptureError(f"{path}: no such folder; give a capture, a result of svu, or textures.")
    found = {key: read_texture(file, key) for key, file in find_textures(path).items()}
    maps, entropy = {key: image for key, (image, _) in found.items()}, read_map(path / ENTROPY)
    if not found and entropy is None:
        raise CaptureError(
            f"{path}: holds neither a capture (capture.json), nor {ENTROPY}, nor textures "
            f"({', '.join(NAMES)} as EXR or PNG); give a folder that does."
        )
    coverage, file = read_map(path / COVERAGE), path / MESH
    record = read_json(path / RECORD) if (path / RECORD).is_file() else {}
    mesh = make("object", read_ply(file)) if file.is_file() else None
    about = "a result of svu recover" if record else "textures"
    return Side(
        name=name, about=about if found else "a result of svu entropy",
        maps=maps if entropy is None else {**maps, "entropy": entropy[..., None]},
        sd=read_deviations(path) if found else {}, seen=None if coverage is None else coverage > 0,
        mesh=mesh, key=mesh_key(mesh) if mesh else text_in(record, "inputs", "mesh"),
        notes=tuple(note for _, note in found.values() if note),
    )  # fmt: skip


def _compared(first: Side, second: Side, size: tuple[int, int], tolerance: float) -> Comparison:
    """Compare the maps that both sides have; refuse sides of different meshes."""
    if first.key and second.key and first.key != second.key:
        raise CaptureError(
            f"{first.name} and {second.name} are about different meshes; compare results of one "
            "mesh with one layout of UVs."
        )
    shared = [name for name in dict.fromkeys((*NAMES, *first.maps))
              if name in first.maps and name in second.maps]  # fmt: skip
    if not shared:
        has = [" and ".join(map(label_of, side.maps)) for side in (first, second)]
        raise CaptureError(
            f"{first.name} has {has[0]}, and {second.name} {has[1]}: nothing to compare; give the "
            "capture itself, or a result of svu recover."
        )
    mesh, area = second.mesh if first.mesh is None else first.mesh, np.ones(size[::-1])
    if mesh is not None:
        laid_out = texels(mesh, size)
        area = laid_out.to_image(np.array(laid_out.footprint, np.float64) ** 2, 0)
    seen = area > 0

    def read(image: np.ndarray, side: Side | None = None) -> np.ndarray:
        """Return a map in the common size, NaN where nothing of any weight is near."""
        weight = np.isfinite(image).all(axis=2)
        if side is not None and side.seen is not None and side.seen.shape == weight.shape:
            weight &= side.seen
        if weight.shape != seen.shape and mesh is not None:
            weight &= texels(mesh, weight.shape[::-1]).inside()
        return np.where(seen[..., None], _resized(image, weight, size), np.float32(np.nan))

    sides = (first, second)
    for side in sides:
        if side.seen is not None:
            seen = seen & (read(side.seen[..., None])[..., 0] > 0.5)
    if not seen.any():
        raise CaptureError(f"{first.name} and {second.name} show no part in common.")
    maps = {}
    for name in shared:
        known = [read(side.sd[name], side) ** 2 for side in sides if name in side.sd]
        a, b = (read(side.maps[name], side) for side in sides)
        sd = np.sqrt(sum(known)) if known else None
        maps[name] = difference(a, b, area, sd=sd, tolerance=tolerance)
    notes = [note for side in sides for note in side.notes]
    notes += [f"{side.name}: taken to be laid out over the same UVs." for side in sides
              if mesh is not None and not side.key]  # fmt: skip
    return Comparison(
        sides=sides, area=area, seen=seen, maps=maps, tolerance=tolerance,
        seen_part=area_share(area, seen), notes=tuple(notes),
    )  # fmt: skip


def difference(
    first: np.ndarray, second: np.ndarray, area: np.ndarray, *, sd: np.ndarray | None = None,
    tolerance: float = 0.0,
) -> Difference:  # fmt: skip
    """Compare two maps (H, W, C); one with a single channel is compared with the other's mean.

    ``area`` (H, W) is that of the texels, and ``sd`` the standard deviation of the difference.
    """
    both = first, second
    if first.shape[2] != second.shape[2]:
        first, second = (x.mean(axis=2, keepdims=True) for x in both)
        sd = None if sd is None else sd.mean(axis=2, keepdims=True)
    values = (second - first).astype(np.float32)
    compared = np.isfinite(values).all(axis=2)
    values[~compared] = np.nan
    deviations = None if sd is None else _deviations(values, sd)
    found, weights = values[compared], area[compared]
    size, mean = np.abs(found).max(axis=1), found.mean(axis=1)
    sure = None if deviations is None else np.abs(deviations[compared, 0]) > CERTAIN
    return Difference(both=both, values=values, deviations=deviations, figures={
        "mean": float(np.average(mean, weights=weights)), "median": weighted_median(size, weights),
        "rms": float(np.sqrt(np.average((found**2).mean(axis=1), weights=weights))),
        "psnr": psnr(first[compared], second[compared]), 
        "beyond": area_share(weights, size > tolerance),
        "certain": None if sure is None else area_share(weights, sure),
        "certain_mean": None if sure is None or not sure.any() else
        float(np.average(mean[sure], weights=weights[sure])),
    })  # fmt: skip


def _deviations(values: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Return differences (H, W, 1) in standard deviations, averaged over a square by 1 / sd^2.

    Neighbours have errors in common, so the mean's variance is that of one texel.
    """
    known = np.isfinite(values) & np.isfinite(sd)
    weight = np.where(known, 1 / np.maximum(sd, LEAST) ** 2, 0)
    planes = np.stack([weight, weight * np.where(known, values, 0), known])
    weights, sums, count = scipy.ndimage.uniform_filter(planes, (1, AROUND, AROUND, 1))
    table = np.divide(sums, np.sqrt(weights * count), out=np.full(sums.shape, np.nan), where=known)
    return largest(table).astype(np.float32)


def largest(image: np.ndarray) -> np.ndarray:
    """Return the value of the largest magnitude among channels, (H, W, 1)."""
    channel = np.abs(np.nan_to_num(image)).argmax(axis=2, keepdims=True)
    return np.take_along_axis(image, channel, axis=2)


def _resized(image: np.ndarray, weight: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a map (H, W, C) in another size, by weights (H, W) of its texels; NaN without any."""

    smaller = size[0] <= image.shape[1] and size[1] <= image.shape[0]
    kind = Image.Resampling.BOX if smaller else Image.Resampling.BILINEAR  # means of areas
    planes = np.concatenate([np.where(weight[..., None] > 0, image, 0), weight[..., None]], axis=-1)
    *sums, total = (np.asarray(Image.fromarray(np.float32(planes[..., k])).resize(size, kind))
                    for k in range(planes.shape[2]))  # fmt: skip
    near = np.where(total > LEAST, total, np.nan)
    return np.stack([plane / near for plane in sums], axis=-1)

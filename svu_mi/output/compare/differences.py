"""Differences between two results for one object, as maps and figures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from svu_mi.calibration.light.resolve_light import with_resolved_light
from svu_mi.capture.capture import Capture
from svu_mi.capture.crop import Detail
from svu_mi.capture.loading import plan_capture
from svu_mi.core.progress import Progress
from svu_mi.core.validation import require_texels
from svu_mi.errors import CaptureError, OptionError
from svu_mi.evaluation.psnr import psnr
from svu_mi.geometry.texels import size_of, texels
from svu_mi.output.estimate_arrays import label_of
from svu_mi.output.interval_summary import area_share, plain_percent, weighted_median
from svu_mi.output.result_maps import ResultMaps, Source, maps_of_estimate, read_result, resampled
from svu_mi.parameters import NAMES
from svu_mi.pipeline import estimate
from svu_mi.presets import preset as find_preset

TOLERANCE = 0.05  # relevant difference if no standard deviation is known
RESOLUTION = 512  # texels per side if both sides are captures
CERTAIN = 2.0  # standard deviations
AROUND = 5  # texels, side of the square over which differences are averaged
LEAST = 1e-3  # lower bound of standard deviations


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Difference of two maps (H, W, C), the second minus the first; NaN where one has no value.

    ``figures`` are weighted by area: ``mean``, ``rms``, ``psnr`` in dB, ``median`` of the largest
    magnitude among channels, fraction ``beyond`` the tolerance, fraction ``certain`` with a
    significant difference, and the mean of significant differences (``certain_mean``) and of their
    magnitudes (``certain_size``).
    """

    both: tuple[np.ndarray, np.ndarray]
    values: np.ndarray
    deviations: np.ndarray | None  # (H, W, 1), in standard deviations, averaged over a square
    figures: Mapping[str, float | None]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Differences between two sides: the second minus the first.

    Example:
        >>> comparison = svu.compare(estimate, recovery)
        >>> list(comparison.differences)
        ['base_color', 'roughness', 'metallic']
        >>> comparison.image("roughness").shape
        (64, 64)
    """

    sides: Sequence[ResultMaps]
    area: np.ndarray  # (H, W) surface area of each texel; 0 outside the charts
    seen: np.ndarray  # (H, W) bool, texels that both sides show
    seen_part: float  # fraction of the surface that both sides show
    maps: Mapping[str, Difference]  # parameters and ``entropy``, as far as both have them
    tolerance: float  # relevant difference if no standard deviation is known
    notes: Sequence[str]  # remarks on conversions and assumptions

    @property
    def differences(self) -> dict[str, Difference]:
        """Differences of parameters."""
        return {name: one for name, one in self.maps.items() if name != "entropy"}

    @property
    def entropy(self) -> Difference | None:
        """Difference of the entropy; None if a side has none."""
        return self.maps.get("entropy")

    def image(self, name: str) -> np.ndarray:
        """Return a difference map by name, such as ``roughness`` or ``roughness_deviations``."""
        entry = self.maps.get(name.removesuffix("_deviations"))
        image = None if entry is None else entry.values if name in self.maps else entry.deviations
        if image is None:
            raise OptionError(f"Comparison.image(): unknown map {name!r}.")
        return image if image.shape[2] > 1 else image[..., 0]

    def sentence(self) -> str:
        """Return "Of the surface that both show, roughness differs significantly on 12 %, ..."."""
        clauses = []
        for name, one in self.differences.items():
            share, how, size = one.figures["certain"], "significantly", one.figures["certain_size"]
            if share is None:
                share, how = one.figures["beyond"] or 0.0, f"by more than {self.tolerance:g}"
            mean = one.figures["certain_mean"]
            by = f" (by {size:.3f} on average, {mean:+.3f} with the sign)" if size else ""
            clauses.append(f"{label_of(name)} differs {how} on {plain_percent(share)}{by}")
        if self.entropy is not None:
            mean = self.entropy.figures["mean"]
            clauses.append(f"the entropy differs by {mean:+.3f} in the mean")
        return f"Of the surface that both show, {', '.join(clauses)}."


def compare(
    a: Source, b: Source, *, preset: str | tuple[str, ...] = "default",
    resolution: int | tuple[int, int] | None = None, tolerance: float = TOLERANCE,
    trust: bool = False, progress: Progress | None = None, memory: float | None = None,
) -> Comparison:  # fmt: skip
    """Compare two results for one object.

    Each side is a ``Capture``, which is estimated first; an ``Estimate``; a ``Recovery``; or the
    path of a folder: a capture, a result of ``svu entropy`` or ``svu recover``, or some of the
    textures ``base_color``, ``roughness``, ``metallic`` (EXR or PNG, over the same UVs). PNG base
    colour is decoded from sRGB. Maps of another size are resampled. Only texels that both sides
    show are compared. If standard deviations are known, a difference is significant where its mean
    over 5 x 5 texels exceeds twice its standard deviation, which combines both sides.

    Args:
        a: First side.
        b: Second side, from which ``a`` is subtracted.
        preset: Preset for captures; one name, or one per side.
        resolution: Texels per side, or (width, height); default: as the coarser side.
        tolerance: Relevant difference if no standard deviation is known.
        trust: Whether scenes may load their own plugins (see ``load_capture``).
        progress: Receiver of stages and timings.
        memory: Limit of the photographs' memory in bytes; None is unlimited.

    Raises:
        SvuError: an option is out of range, the sides show different objects, or an error of
            ``load_capture``.

    Example:
        >>> comparison = svu.compare(estimate, recovery, tolerance=0.1)
        >>> comparison.seen_part > 0.5
        True
        >>> comparison.sentence()[:23]
        'Of the surface that bot'
    """
    plan = ComparisonPlan(a, b, preset=preset, resolution=resolution, tolerance=tolerance)
    stages = progress or Progress()
    for index, source in plan.captures:
        if not isinstance(source, Capture):
            with stages.stage("Loading the capture"):
                detail = Detail(texels=plan.size)
                planned = plan_capture(source, trust=trust, light="optional", detail=detail)
                source = planned.read(memory)
        plan.estimate(index, source, stages)
    return plan.compared()


class ComparisonPlan:
    """Checked options and loaded results; ``captures`` must be estimated before ``compared``."""

    def __init__(self, a: Source, b: Source, *, preset: Any, resolution: Any, tolerance: Any):
        pair = (preset, preset) if isinstance(preset, str) else preset
        if len(pair) != 2:
            raise OptionError(
                "compare(): preset must be the name of a preset, or two names for a and b, got "
                f"{preset!r}.", shell="--preset takes one preset, or two for A and B."
            )  # fmt: skip
        if not 0 <= tolerance < np.inf:
            raise OptionError(
                f"compare(): tolerance must be a number of at least 0, got {tolerance!r}.",
                shell=f"--tolerance must be at least 0, got {tolerance:g}.",
            )
        size = None if resolution is None else size_of(resolution)
        if size is not None:
            require_texels(size, "compare(): resolution")
        self.tolerance = tolerance
        self.presets = [find_preset(name, method="angular").name for name in pair]
        named: Any = ((a, "the first"), (b, "the second"))
        self.names = [str(x) if isinstance(x, str | Path) else word for x, word in named]
        if self.names[0] == self.names[1]:
            self.names = [f"{self.names[0]} ({chosen})" for chosen in self.presets]
        self.sides = [read_result(x, name) for x, name in zip((a, b), self.names, strict=True)]
        self.captures = [(k, x) for k, (x, _) in enumerate(named) if self.sides[k] is None]
        shapes = [max(x.shape[:2] for x in side.maps.values()) for side in self.sides if side]
        self.size = size or min(((w, h) for h, w in shapes), default=(RESOLUTION, RESOLUTION))

    def estimate(self, index: int, capture: Capture, progress: Progress) -> None:
        """Estimate a side; if its capture is on disk and has no light, estimate the light first."""
        if not isinstance(dict(self.captures)[index], Capture):
            capture = with_resolved_light(capture, gains=None, progress=progress)
        preset, grid = self.presets[index], texels(capture.mesh, self.size)
        # Errors of the model are common to both sides, so they do not widen the difference.
        own = find_preset(preset, method="angular", folds=0)
        result = estimate(capture, grid, preset=own, progress=progress)
        about = f"a capture, estimated with the preset {preset}"
        self.sides[index] = maps_of_estimate(result, self.names[index], about)

    def compared(self) -> Comparison:
        """Compare the maps that both sides have; raise an error if the meshes differ."""
        first, second = sides = [side for side in self.sides if side is not None]
        if first.key and second.key and first.key != second.key:
            raise CaptureError(
                f"{first.name} and {second.name} belong to different meshes; compare results for "
                "one mesh with the same UVs."
            )
        shared = first.maps.keys() & second.maps
        names = [name for name in dict.fromkeys((*NAMES, *first.maps)) if name in shared]
        if not names:
            has = [" and ".join(map(label_of, side.maps)) for side in sides]
            raise CaptureError(
                f"{first.name} has {has[0]}, and {second.name} {has[1]}: nothing to compare; give "
                "the capture itself, or a result of svu recover."
            )
        mesh, area = second.mesh if first.mesh is None else first.mesh, np.ones(self.size[::-1])
        if mesh is not None:
            grid = texels(mesh, self.size)
            area = grid.to_image(np.array(grid.footprint, np.float64) ** 2, 0)
        seen = area > 0

        def read(image: np.ndarray, shown: np.ndarray | None = None) -> np.ndarray:
            common = resampled(image, self.size, shown, mesh)
            return np.where(seen[..., None], common, np.float32(np.nan))

        for side in sides:
            if side.seen is not None:
                seen = seen & (read(side.seen[..., None])[..., 0] > 0.5)
        if not seen.any():
            raise CaptureError(f"{first.name} and {second.name} show no common surface.")
        maps = {}
        for name in names:
            variances = [read(s.sd[name], s.seen) ** 2 for s in sides if name in s.sd]
            sd = np.sqrt(sum(variances)) if variances else None
            a, b = (read(side.maps[name], side.seen) for side in sides)
            maps[name] = difference(a, b, area, sd=sd, tolerance=self.tolerance)
        notes = [note for side in sides for note in side.notes]
        notes += [f"{side.name}: assumed to use the same UVs." for side in sides
                  if mesh is not None and not side.key]  # fmt: skip
        return Comparison(
            sides=sides, area=area, seen=seen, maps=maps, tolerance=self.tolerance,
            seen_part=area_share(area, seen), notes=notes,
        )  # fmt: skip


def difference(
    first: np.ndarray, second: np.ndarray, area: np.ndarray, *, sd: np.ndarray | None = None,
    tolerance: float = 0.0,
) -> Difference:  # fmt: skip
    """Compare two maps (H, W, C), or their means over channels if C differs.

    ``area`` (H, W) contains texel areas, ``sd`` the standard deviation of the difference.
    """
    both = first, second
    if first.shape[2] != second.shape[2]:
        first, second = (x.mean(axis=2, keepdims=True) for x in both)
        sd = None if sd is None else sd.mean(axis=2, keepdims=True)
    values = (second - first).astype(np.float32)
    compared = np.isfinite(values).all(axis=2)
    values[~compared] = np.nan
    changes, weights = values[compared], area[compared]
    size, mean = np.abs(changes).max(axis=1), changes.mean(axis=1)
    figures: dict[str, float | None] = {
        "mean": float(np.average(mean, weights=weights)), "median": weighted_median(size, weights),
        "rms": float(np.sqrt(np.average((changes**2).mean(axis=1), weights=weights))),
        "psnr": psnr(first[compared], second[compared]),
        "beyond": area_share(weights, size > tolerance),
        **dict.fromkeys(("certain", "certain_mean", "certain_size")),
    }  # fmt: skip
    deviations = None if sd is None else _deviations(values, sd)
    if deviations is not None:
        sure = np.abs(deviations[compared, 0]) > CERTAIN
        figures["certain"] = area_share(weights, sure)
        if sure.any():
            for key, of in (("certain_mean", mean), ("certain_size", size)):
                figures[key] = float(np.average(of[sure], weights=weights[sure]))
    return Difference(both=both, values=values, deviations=deviations, figures=figures)


def _deviations(values: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Return local means of differences, in units of their standard deviations, (H, W, 1)."""
    # Errors of neighbours are correlated, so the mean gets the variance of a single texel.
    known = np.isfinite(values) & np.isfinite(sd)
    weight = np.where(known, 1 / np.maximum(sd, LEAST) ** 2, 0)
    planes = np.stack([weight, weight * np.where(known, values, 0), known])
    weights, sums, count = scipy.ndimage.uniform_filter(planes, (1, AROUND, AROUND, 1))
    table = np.divide(sums, np.sqrt(weights * count), out=np.full(sums.shape, np.nan), where=known)
    return largest(table).astype(np.float32)


def largest(image: np.ndarray) -> np.ndarray:
    """Return the value of the channel with the largest magnitude, (H, W, 1)."""
    channel = np.abs(np.nan_to_num(image)).argmax(axis=2, keepdims=True)
    return np.take_along_axis(image, channel, axis=2)

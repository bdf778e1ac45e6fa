"""Two results about one object, texel by texel: what differs, and of which one can be certain.

    svu.compare("before", "after")                      # captures: both are estimated
    svu.compare("out/textures", "painted")              # a recovery, and anybody's textures
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture.loading import Preflight
from svu_mi.errors import CaptureError, OptionError
from svu_mi.output.compare_difference import Difference, difference
from svu_mi.output.compare_options import require_tolerance, size_asked, two_presets
from svu_mi.output.compare_sides import (
    Side,
    Source,
    Work,
    estimated,
    is_capture,
    of_estimate,
    of_folder,
    of_recovery,
)
from svu_mi.output.compare_surface import Surface
from svu_mi.output.knowledge import part, plain_percent
from svu_mi.output.result import words
from svu_mi.parameters import NAMES
from svu_mi.pipeline import Estimate
from svu_mi.progress import Progress
from svu_mi.recovery.recover import Recovery

TOLERANCE = 0.05  # difference that counts where no standard deviation is known
RESOLUTION = 512  # texels per side, where only captures are compared
STRAY = 0.02  # part of what a photograph shows that may lie outside the charts of a mesh


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What differs between two sides; differences are the second minus the first.

    Attributes:
        sides: what was compared, each with its maps.
        surface: the T texels that they have in common.
        seen: (T,) bool, those that both show.
        differences: by parameter that both have.
        entropy: difference of the entropies, None where one is not known.
        tolerance: difference that counts where no standard deviation is known.
        seen_part: part of the surface that both show.
        notes: sentences on how it was compared.
    """

    sides: tuple[Side, Side]
    surface: Surface
    seen: np.ndarray
    differences: Mapping[str, Difference]
    entropy: Difference | None
    tolerance: float
    seen_part: float
    notes: tuple[str, ...] = field(default=())

    def image(self, name: str) -> np.ndarray:
        """Return a map (H, W), or (H, W, 3) for base colour; NaN where not both have a value.

        Args:
            name: a parameter, or ``entropy``; or a parameter and ``_deviations``: its difference
                in standard deviations.

        Raises:
            OptionError: there is no such map.
        """
        key = name.removesuffix("_deviations")
        found = self.entropy if key == "entropy" else self.differences.get(key)
        values = None if found is None else found.values if key == name else found.deviations
        if values is None:
            raise OptionError(f"Comparison.image(): there is no map {name!r}.")
        image = self.surface.to_image(values.reshape(self.surface.count, -1), np.nan)
        return image if image.shape[2] > 1 else image[..., 0]

    def sentence(self) -> str:
        """Word it: "Of the surface that both show, roughness differs certainly on 12 %, ..."."""
        text = "Of the surface that both show, "
        if self.differences:
            text += self._differing()
        if self.entropy is not None:
            text += "; " if self.differences else ""
            text += f"the entropy differs by {self.entropy.figures.mean:+.3f} in the mean"
        return f"{text}."

    def _differing(self) -> str:
        told, same, last = [], [], ""
        for name, one in self.differences.items():
            found = one.figures
            verb = f"differs by more than {self.tolerance:g}"
            if found.certain is not None:
                verb = "differs certainly"
            if found.differs == 0:
                same.append(words(name))
                continue
            by = "" if found.certain_mean is None else f" (by {found.certain_mean:+.3f})"
            said = "" if verb == last else f" {verb}"
            told.append(f"{words(name)}{said} on {plain_percent(found.differs)}{by}")
            last = verb
        if not told:
            return f"nothing {verb} ({', '.join(same)})"
        return ", ".join([*told, *([f"{' and '.join(same)} nowhere"] if same else [])])


def compare(
    a: Source,
    b: Source,
    *,
    preset: str | tuple[str, ...] = "default",
    resolution: int | tuple[int, int] | None = None,
    tolerance: float = TOLERANCE,
    trust: bool = False,
    progress: Progress | None = None,
    preflight: Callable[[str, tuple[int, int]], Preflight] | None = None,
    memory: float | None = None,
) -> Comparison:
    """Compare two results about one object.

    Each side is a capture, which is estimated; an ``Estimate``; a ``Recovery``; or a folder: a
    capture's, a result of ``svu entropy`` or ``svu recover``, or any with textures ``base_color``,
    ``roughness``, ``metallic`` (some of them, EXR or PNG, over the same UVs). Of an 8- or 16-bit
    base colour sRGB is decoded. Maps of another size are resampled; what not both show is left out.
    Where a side says how certain it is, a difference counts where it is more than twice as large
    as both together may be off, in the mean over the texels around.

    Args:
        a: the first, such as before a change, or what was expected.
        b: the second, which the first is subtracted from.
        preset: of estimates of captures; one for both, or one for each.
        resolution: texels per side, or (width, height); by default that of the coarser textures,
            512 if there are none.
        tolerance: difference that counts where no standard deviation is known.
        trust: as of ``load_capture``.
        progress: shows what is going on.
        preflight: by the path of a capture and the (width, height) of its maps, the
            ``preflight`` of ``load_capture``.
        memory: as of ``load_capture``.

    Raises:
        CaptureError: they are not of one object, or have nothing in common; or as
            ``load_capture``.
        OptionError: an option out of range, or an unknown preset.
        MeshError: a mesh cannot carry texels.
    """
    presets, asked = two_presets(preset), size_asked(resolution)
    require_tolerance(tolerance)
    names = _names(a, b, presets)
    sides: list[Side | None] = [
        None if is_capture(source) else _side(source, name)
        for source, name in zip((a, b), names, strict=True)
    ]
    size = asked or _size([side for side in sides if side is not None])
    work = Work(
        size=size, trust=trust, progress=progress or Progress(), preflight=preflight, memory=memory
    )
    first, second = (
        side or estimated(source, name, chosen, work)
        for side, source, name, chosen in zip(sides, (a, b), names, presets, strict=True)
    )
    _require_one_mesh(first, second)
    meshes = [side.mesh for side in (first, second) if side.mesh is not None]
    surface = Surface.of(meshes, size, (first.name, second.name))
    return _compared((first, second), surface, tolerance)


def _names(a: Source, b: Source, presets: tuple[str, str]) -> list[str]:
    """Return what sides are called: their paths, and presets where these are the same."""
    names = [
        str(source) if isinstance(source, str | Path) else word
        for source, word in zip((a, b), ("the first", "the second"), strict=True)
    ]
    if names[0] == names[1]:
        return [f"{name} ({chosen})" for name, chosen in zip(names, presets, strict=True)]
    return names


def _side(source: Source, name: str) -> Side:
    if isinstance(source, Estimate):
        return of_estimate(source, name)
    if isinstance(source, Recovery):
        return of_recovery(source, name)
    if not isinstance(source, str | Path):
        raise OptionError(
            "compare() takes captures, estimates, recoveries and folders, got a "
            f"{type(source).__name__}."
        )
    return of_folder(Path(source), name)


def _size(sides: list[Side]) -> tuple[int, int]:
    """Return (W, H) that all is compared at where none is asked for: the smaller of the sides."""
    if not sides:
        return RESOLUTION, RESOLUTION
    widths, heights = zip(*(side.size for side in sides), strict=True)
    return min(widths), min(heights)


def _require_one_mesh(first: Side, second: Side) -> None:
    """Refuse results of different meshes where only their records can tell."""
    both = first.mesh is not None and second.mesh is not None
    if not both and first.key and second.key and first.key != second.key:
        raise CaptureError(
            f"{first.name} and {second.name} are about different meshes; compare results of one "
            "mesh with one layout of UVs."
        )


def _compared(sides: tuple[Side, Side], surface: Surface, tolerance: float) -> Comparison:
    seen = np.ones(surface.count, bool)
    for side in sides:
        if side.seen is not None:
            _require_inside(side, surface)
            seen &= surface.read(side.seen[..., None].astype(np.float32))[:, 0] > 0.5
    if not seen.any():
        raise CaptureError(f"{sides[0].name} and {sides[1].name} show no part in common.")
    names = [name for name in dict.fromkeys((*NAMES, *sides[0].values))
             if all(name in side.values for side in sides)]  # fmt: skip
    differences = {
        name: difference(
            surface, *(_read(side, side.values[name], surface, seen) for side in sides),
            sd=_both_sd(sides, name, surface, seen), tolerance=tolerance,
        )
        for name in names
    }  # fmt: skip
    maps = [side.entropy for side in sides]
    entropy = None
    if all(image is not None for image in maps):
        entropy = difference(surface, *(
            _read(side, np.asarray(side.entropy)[..., None], surface, seen) for side in sides
        ), tolerance=tolerance)  # fmt: skip
    if not differences and entropy is None:
        raise CaptureError(
            f"{sides[0].name} has {_has(sides[0])}, and {sides[1].name} {_has(sides[1])}: nothing "
            "to compare; give the capture itself, or a result of svu recover."
        )
    notes = [note for side in sides for note in side.notes]
    notes += [f"{side.name}: taken to be laid out over the same UVs." for side in sides
              if not side.key and surface.mesh is not None]  # fmt: skip
    return Comparison(
        sides=sides, surface=surface, seen=seen, differences=differences, entropy=entropy,
        tolerance=tolerance, seen_part=part(surface.area, seen), notes=tuple(notes),
    )  # fmt: skip


def _require_inside(side: Side, surface: Surface) -> None:
    """Refuse maps of which much lies where the mesh has no chart."""
    if side.mesh is not None or surface.mesh is None or side.seen is None:
        return
    stray = side.seen & ~surface.near_charts(side.seen.shape)
    if stray.sum() > STRAY * side.seen.sum():
        raise CaptureError(
            f"{side.name}: its maps lie outside the charts of the other's mesh, so they are about "
            "another object; compare results of one mesh."
        )


def _has(side: Side) -> str:
    maps = [words(name) for name in side.values]
    return " and ".join(maps + (["entropy"] if side.entropy is not None else []))


def _read(side: Side, image: np.ndarray, surface: Surface, seen: np.ndarray) -> np.ndarray:
    """Return a map at the texels (T, C), without what not both show."""
    counts = None
    if side.seen is not None and side.seen.shape == image.shape[:2]:
        counts = side.seen
    values = surface.read(image, counts)
    values[~seen] = np.nan
    return values


def _both_sd(
    sides: tuple[Side, Side], name: str, surface: Surface, seen: np.ndarray
) -> np.ndarray | None:
    """Return the standard deviation of a difference (T, C), of what is known of it."""
    known: list[Any] = [
        _read(side, side.sd[name], surface, seen) for side in sides if name in side.sd
    ]
    return np.sqrt(sum(sd**2 for sd in known)) if known else None

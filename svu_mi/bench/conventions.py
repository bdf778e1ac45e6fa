"""How often ``svu check`` finds a mistake about axes: captures that were spoiled on purpose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from svu_mi.bench.accuracy import Bench
from svu_mi.bench.captures import some_views
from svu_mi.bench.cells import Cell
from svu_mi.bench.store import Store
from svu_mi.bench.text import table
from svu_mi.capture import Capture
from svu_mi.checking.appearance import read_texture
from svu_mi.checking.apply import spoil
from svu_mi.checking.points import scatter_points
from svu_mi.checking.record import Finding
from svu_mi.checking.run import find_mistakes
from svu_mi.formats.fixes import FIXES, fixes_named
from svu_mi.formats.source import OPENCV, OPENGL
from svu_mi.metrics.images import srgb

FEW = 8  # views
WHITE = 0.97  # of the object's pixels that an 8-bit photograph does not clip
OUTCOMES = ("right", "among several", "silent", "misled")


@dataclass(frozen=True)
class Case:
    """A mistake.

    Attributes:
        fixes: that put it right, in this order.
        camera_axes: of the file, for ``camera-inverse``.
    """

    fixes: tuple[str, ...] = ()
    camera_axes: np.ndarray = field(default_factory=lambda: np.eye(4))

    @property
    def group(self) -> str:
        """Kind of the mistake, as the tables have it."""
        kinds = list(dict.fromkeys(FIXES[name].kind for name in self.fixes))
        return " and ".join(kinds) if kinds else "nothing wrong"

    def made(self, capture: Capture) -> Capture:
        """Return a right capture with this mistake in it."""
        for fix in reversed(fixes_named(self.fixes)):
            capture = spoil(capture, fix, self.camera_axes)
        return capture


CASES = (
    Case(),
    *(Case((name,)) for name in FIXES),
    Case(("camera-inverse",), OPENGL),
    Case(("camera-inverse",), OPENCV),
    Case(("light-x90", "light-turn-90")),  # a Blender map read as Mitsuba's
    Case(("light-turn-270", "light-x270")),  # the other way round
    Case(("camera-x180", "light-x90", "light-turn-90")),
    Case(("mesh-x90", "light-turn-180")),
)


def eight_bit(capture: Capture) -> Capture:
    """Return the photographs as 8-bit sRGB would have kept them, clipped pixels left out."""
    shown = [image[mask] for image, mask in _pairs(capture)]
    brightest = np.nanmax(np.concatenate(shown), axis=1)
    white = float(np.nanquantile(brightest, WHITE))
    images = []
    for image in capture.images:
        encoded = np.round(255 * srgb(np.clip(image / white, 0, 1))) / 255
        linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
        clipped = ~(encoded <= 0.98).all(axis=-1, keepdims=True)  # NaN too
        images.append(np.where(clipped, np.nan, linear).astype(np.float32))
    return replace(capture, images=tuple(images))


def without_masks(capture: Capture) -> Capture:
    """Return the capture without masks: whatever is behind the object stays in the pictures."""
    return replace(capture, masks=(None,) * capture.count)


def before_backdrop(capture: Capture) -> Capture:
    """Return the photographs as taken before a grey wall, a little brighter above; no masks."""
    level = float(np.nanmedian(np.concatenate([image[mask] for image, mask in _pairs(capture)])))
    images = []
    for image, mask in _pairs(capture):
        height = np.linspace(1.15, 0.85, len(mask))[:, None, None]
        images.append(np.where(mask[..., None], image, level * height).astype(np.float32))
    return without_masks(replace(capture, images=tuple(images)))


def _pairs(capture: Capture) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for image, mask in zip(capture.images, capture.masks, strict=True):
        yield image, np.ones(image.shape[:2], bool) if mask is None else mask


PHOTOGRAPHS: dict[str, Callable[[Capture], Capture]] = {
    "HDR, masks": lambda capture: capture,
    "8 bits, masks": eight_bit,
    "HDR, no masks": without_masks,
    "8 bits, backdrop, no masks": lambda capture: eight_bit(before_backdrop(capture)),
    f"{FEW} views, HDR, masks": lambda capture: some_views(capture, FEW),
    f"{FEW} views, HDR, no masks": lambda capture: without_masks(some_views(capture, FEW)),
}


def outcome(findings: Sequence[Finding], case: Case) -> str:
    """Return one of ``OUTCOMES`` for what a check has said about a case."""
    said = [name for one in findings if one.verdict == "wrong" for name in one.fixes]
    unsure = [one for one in findings if one.verdict == "unclear"]
    if not unsure:
        if same(said, case.fixes):
            return "right"
        return "misled" if said else "silent"
    for one in unsure:
        if any(same([*said, *words], case.fixes) for words in (one.fixes, *one.alternatives)):
            return "among several"
    return "misled" if any(name not in case.fixes for name in said) else "silent"


def same(names: Sequence[str], others: Sequence[str]) -> bool:
    """Return whether corrections come to the same, whatever they are called."""
    return all(np.allclose(_product(names, kind), _product(others, kind)) for kind in
               ("light", "mesh")) and _rest(names) == _rest(others)  # fmt: skip


def _product(names: Sequence[str], kind: str) -> np.ndarray:
    result = np.eye(3)
    for fix in fixes_named(names):
        if fix.kind == kind and fix.matrix is not None:
            result = result @ fix.matrix
    return result


def _rest(names: Sequence[str]) -> set[str]:
    return {name for name in names if FIXES[name].kind in ("camera", "texture")}


def run_conventions(bench: Bench, cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Check spoiled captures of every cell; what is finished is taken from disk.

    Args:
        bench: where, and how large; ``quick`` leaves out some photographs.
        cells: objects x lights.

    Returns:
        All records of ``spoiled``.
    """
    store, rows = Store(bench.folder / "conventions"), []
    photographs = tuple(PHOTOGRAPHS)[:: 3 if bench.quick else 1]
    for cell in cells:
        capture = bench.capture(cell)
        with bench.progress.stage(f"Spoiling {cell.title}"):
            key = bench.key(cell, ())
            compute = partial(_finished, capture, cell.title, photographs)
            rows += store.recall(cell.name, key, compute, fresh=bench.fresh)["checks"]
    return rows


def _finished(capture: Capture, title: str, photographs: Sequence[str]) -> dict[str, Any]:
    return {"checks": spoiled(capture, title, photographs=photographs)}


def spoiled(
    capture: Capture, title: str, cases: Sequence[Case] = CASES,
    photographs: Sequence[str] = tuple(PHOTOGRAPHS),
) -> list[dict[str, Any]]:  # fmt: skip
    """Spoil a right capture in every way, and check each.

    Args:
        capture: with masks.
        title: of the capture.
        cases: mistakes.
        photographs: names among ``PHOTOGRAPHS``.

    Returns:
        A record per check: ``cell``, ``photographs``, ``group``, ``fixes``, ``outcome`` and
        ``said``, the sentences.
    """
    textured = read_texture(capture, scatter_points(capture.shape)) is not None
    found = []
    for name in photographs:
        taken = PHOTOGRAPHS[name](capture)
        for case in cases:
            if "texture-flip-v" in case.fixes and not textured:
                continue
            findings, _ = find_mistakes(case.made(taken))
            found.append({
                "cell": title, "photographs": name, "group": case.group, "fixes": case.fixes,
                "outcome": outcome(findings, case), "said": [one.sentence for one in findings],
            })  # fmt: skip
    return found


def conventions_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table: kinds of mistakes x photographs.

    Args:
        rows: records of ``spoiled``.
    """
    groups = list(dict.fromkeys(row["group"] for row in rows))
    columns = list(dict.fromkeys(row["photographs"] for row in rows))
    lines = []
    for group in groups:
        line: list[object] = [group]
        for column in columns:
            cell = Counter(
                row["outcome"]
                for row in rows
                if row["group"] == group and row["photographs"] == column
            )
            total = max(sum(cell.values()), 1)
            line.append(" / ".join(f"{100 * cell[one] / total:.0f}" for one in OUTCOMES))
        lines.append([*line, sum(row["group"] == group for row in rows)])
    return (
        f"Checks of captures that were spoiled on purpose, in percent: {' / '.join(OUTCOMES)}.\n\n"
        + table(["mistake", *columns, "checks"], lines)
    )

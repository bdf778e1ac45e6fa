"""``check.html``: whether a capture fits its photographs, for eyes; ``check.json`` for programs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.fingerprint import capture_key
from svu_mi.capture.poses import bounding_sphere
from svu_mi.capture.scene import find_environment, to_world
from svu_mi.checking.apply import apply_fixes
from svu_mi.checking.frames import Frames, reduced
from svu_mi.checking.record import Check, Finding, Summary
from svu_mi.checking.silhouettes import outline, silhouettes
from svu_mi.formats.fixes import fixes_named
from svu_mi.light.environment import nearest_node, read_environment
from svu_mi.light.levels import resolved
from svu_mi.output.manifest import environment_record, write_manifest
from svu_mi.output.page import THUMBNAIL, Picture, photograph, write_page
from svu_mi.output.style import AFTER, BEFORE
from svu_mi.output.upright import facing, up_of
from svu_mi.output.views import tone_mapped
from svu_mi.results.writing import writing

TEMPLATE, RECORD = "check.html", "check.json"
MOST = 120  # thumbnails; the worst
ROWS = 8  # of each table of hypotheses
LIGHT = (480, 240)  # pixels of a panorama
QUESTIONS = {
    "poses": "Cameras and mesh", "light": "Environment map", "texture": "Texture coordinates",
}  # fmt: skip


def write_check(
    capture: Capture, found: Check, folder: str | Path, *,
    settings: Mapping[str, Any] | None = None,
) -> None:  # fmt: skip
    """Write ``check.html``, with all its pictures inside, and ``check.json``.

    Args:
        capture: what was checked.
        found: what was found.
        folder: made if missing.
        settings: what the caller was asked for.

    Raises:
        OutputError: a file cannot be written.
    """
    with writing(folder, "check", RECORD, capture=capture_key(capture)) as draft:
        _write_page(capture, found, draft.folder / TEMPLATE)
        record = {"fits": found.fits, "fixes": found.fixes, "check": found, "settings": settings}
        write_manifest(
            draft.folder / RECORD,
            {**record, "environment": environment_record(), **draft.entries()},
        )


def _write_page(capture: Capture, found: Check, path: Path) -> None:
    fixes = fixes_named(found.fixes)
    corrected = apply_fixes(capture, fixes, found.camera_axes) if fixes else capture
    write_page(
        path,
        TEMPLATE,
        verdict=verdict(found),
        remedy=remedy(found),
        numbers=_numbers(found),
        findings=[_finding(one) for one in found.findings],
        views=_views(capture, corrected, found),
        total=len(found.views),
        panoramas=_panoramas(capture, corrected),
        source=str(capture.source or ""),
        is_corrected=bool(fixes),
        before=BEFORE,
        after=AFTER,
    )


def verdict(found: Check) -> str:
    """Return the outcome as one sentence."""
    if found.fixes:
        count = len(found.fixes)
        words = "one correction makes" if count == 1 else f"{count} corrections make"
        return f"Something is wrong, and {words} it fit: {' + '.join(found.fixes)}."
    unclear = [one for one in found.findings if one.verdict == "unclear"]
    if unclear:
        return "Something may be wrong, but which correction is right cannot be told."
    return "The capture fits its photographs, as far as can be told."


def remedy(found: Check) -> str:
    """Return the command that corrects the capture; empty if nothing is to be done."""
    if not found.fixes:
        return ""
    words = " ".join(f"--fix {name}" for name in found.fixes)
    return f"Import it again with: svu import ... {words}"


def _numbers(found: Check) -> list[tuple[str, str, str]]:
    before, after = Summary.of(found.views), Summary.of(found.corrected)
    rows = (
        ("Silhouettes and masks overlap by", "overlap", "intersection over union; 1 is perfect"),
        ("Edges lie on the outline", "contrast", "rank of the gradient; 0.5 is chance"),
        ("Colours differ by", "color_error", "of the mean, from a diffuse object in this light"),
    )
    found_numbers = []
    for title, name, note in rows:
        old, new = getattr(before, name), getattr(after, name)
        if old is None and new is None:
            continue
        if found.corrected is not found.views:
            note = f"{_number(new)} when corrected; {note}"
        found_numbers.append((title, _number(old), note))
    return found_numbers


def _number(value: float | None) -> str:
    return "not told" if value is None else f"{value:.2f}"


def _finding(one: Finding) -> dict[str, Any]:
    scores = [hypothesis.score for hypothesis in one.hypotheses]
    low, high = min(scores, default=0.0), max(scores, default=1.0)
    shown = list(one.hypotheses[:ROWS])
    shown += [h for h in one.hypotheses[ROWS:] if not h.fixes]  # how it is, however bad
    return {
        "title": QUESTIONS[one.question],
        "verdict": one.verdict,
        "sentence": one.sentence,
        "cues": list(shown[0].cues) if shown else [],
        "rows": [
            {
                "title": hypothesis.title,
                "width": 3 + 97 * (hypothesis.score - low) / max(high - low, 1e-9),
                "is": not hypothesis.fixes,
                "cues": [f"{value:.2f}" for value in hypothesis.cues.values()],
            }
            for hypothesis in shown
        ],
        "left_out": len(one.hypotheses) - len(shown),
    }


def _views(capture: Capture, corrected: Capture, found: Check) -> list[dict[str, Any]]:
    frames = reduced(capture, THUMBNAIL)
    seen = silhouettes(capture, frames)
    after = seen if corrected is capture else silhouettes(corrected, reduced(corrected, THUMBNAIL))
    place = {view: index for index, view in enumerate(frames.views)}
    better = {one.view: one for one in found.corrected}
    shown = []
    for one in found.worst[:MOST]:
        index = place[one.view]
        picture = _screen(frames, index, after[index])
        _draw(picture, seen[index], BEFORE)
        if corrected is not capture:
            _draw(picture, after[index], AFTER)
        rows = [("IoU", "overlap"), ("edges", "contrast"), ("colour error", "color_error")]
        shown.append({
            "name": one.name,
            "picture": photograph(picture),
            "numbers": [
                (title, _change(getattr(one, name), getattr(better[one.view], name)))
                for title, name in rows
                if getattr(one, name) is not None or getattr(better[one.view], name) is not None
            ],
        })  # fmt: skip
    return shown


def _change(before: float | None, after: float | None) -> str:
    old, new = ("-" if value is None else f"{value:.2f}" for value in (before, after))
    return old if old == new else f"{old} → {new}"


def _screen(frames: Frames, index: int, seen: np.ndarray) -> np.ndarray:
    """Expose a photograph for the object; what is clipped is white."""
    image = frames.radiance[index]
    mask = frames.masks[index]
    shown = tone_mapped(image, seen if mask is None else mask)
    shown[~np.isfinite(image).all(axis=2)] = 1.0
    return shown


def _draw(picture: np.ndarray, seen: np.ndarray, color: tuple[float, float, float]) -> None:
    """Draw an outline into a picture, two pixels wide, on both sides of the edge."""
    picture[outline(seen) | outline(~seen)] = color


def _panoramas(capture: Capture, corrected: Capture) -> list[tuple[Picture, str]]:
    """The light as it is and, if that differs, corrected, around the object."""
    shown = [(_panorama(capture), "as the capture says")]
    return shown if corrected is capture else [*shown, (_panorama(corrected), "corrected")]


def _panorama(capture: Capture) -> Picture:
    """Draw the light as one would see it from the object: up is the cameras' up.

    The centre is where the first camera looks, so that it can be compared with what is behind
    the object in the first photograph. Cameras are dots.
    """
    emitter = find_environment(capture.scene, str(capture.source or "scene"))
    environment = read_environment(emitter)
    grid = resolved(environment)
    poses = np.array([to_world(sensor) for sensor in capture.used_sensors])
    # Seen from within, right is where it is left of somebody in front.
    frame = facing(up_of(poses), poses[0, :3, 2]) * [[-1], [1], [1]]
    width, height = LIGHT
    azimuth = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    flat = np.cos(elevation)[:, None]
    local = np.stack([
        flat * np.sin(azimuth), np.broadcast_to(np.sin(elevation)[:, None], (height, width)),
        flat * np.cos(azimuth),
    ], axis=-1)  # fmt: skip
    row, column = nearest_node(local @ frame @ environment.to_local.T, *grid.shape[:2])
    picture = tone_mapped(grid[row, column])
    center, _ = bounding_sphere(capture.shape)
    toward = (poses[:, :3, 3] - center) @ frame.T
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-12)
    across = (np.arctan2(toward[:, 0], toward[:, 2]) / (2 * np.pi) + 0.5) * width
    down = (0.5 - np.arcsin(np.clip(toward[:, 1], -1, 1)) / np.pi) * height
    for i, j in zip(down.astype(int), across.astype(int), strict=True):
        for size, color in ((4, (0, 0, 0)), (3, (1.0, 0.85, 0.1))):
            picture[max(i - size, 0) : i + size, max(j - size, 0) : j + size] = color
    return photograph(picture, None)

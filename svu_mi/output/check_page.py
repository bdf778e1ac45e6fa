"""``check.html`` and ``check.json``: consistency of a capture with its photographs."""

import os
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from svu_mi.calibration.checks.axis_hypotheses import apply_fixes
from svu_mi.calibration.checks.check_result import Check, Finding, ViewMeans
from svu_mi.calibration.checks.mesh_similarity import MeshSimilarity
from svu_mi.calibration.checks.surface_samples import emitter_of
from svu_mi.calibration.checks.thumbnails import (
    Thumbnails,
    outline,
    reduce_photographs,
    silhouettes,
)
from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import capture_key
from svu_mi.capture.importers.axis_fixes import find_fixes
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import bounding_sphere
from svu_mi.capture.tonemap import tone_mapped
from svu_mi.capture.up_direction import up_of_poses
from svu_mi.core.io.output_folder import writing
from svu_mi.light.environment import nearest_node, read_environment
from svu_mi.light.prefiltered import rasterized
from svu_mi.output.html import PageImage, embedded_jpeg, write_page
from svu_mi.output.object_views import viewing_frame
from svu_mi.output.run_record import environment_record, write_manifest
from svu_mi.output.style import AFTER, BEFORE

AXES = ("poses", "light", "texture")  # questions with corrections
TEMPLATE, RECORD = "check.html", "check.json"
PICTURE = 400  # pixels of a photograph's longer side, enough to judge its outline
MOST = 120  # largest number of thumbnails, worst first
ROWS = 8  # largest number of hypotheses in a table
LIGHT = (480, 240)  # pixels of a panorama
QUESTIONS = {
    "poses": "Cameras and mesh", "cameras": "Accuracy of the poses", "light": "Environment map",
    "texture": "Texture coordinates", "uvs": "Layout of the UVs",
    "gain": "Gains or outliers", "saturation": "Saturated pixels",
    "sources": "Sources of the light", "ignored": "Ignored effects",
    "number": "Number of photographs",
}  # fmt: skip
# Attributes of ViewCheck and Summary: title of their mean, explanation, short label.
MEASURES = {
    "overlap": (
        "Overlap of silhouettes and masks", "intersection over union; 1 is perfect", "IoU"
    ),
    "contrast": (
        "Contrast along the outline", "rank of the gradient; 0.5 is chance", "contrast"
    ),
    "color_error": (
        "Diffuse misfit", "relative, from a diffuse object; gloss raises it", "diffuse misfit"
    ),
}  # fmt: skip


def write_check(
    capture: Capture, check: Check, folder: str | os.PathLike[str], *,
    settings: Mapping[str, Any] | None = None, remedy: str = "",
) -> None:  # fmt: skip
    """Write ``check.html``, with embedded pictures, and ``check.json``.

    Raises:
        OutputError: a file cannot be written.
    """
    with writing(folder, "check", RECORD, capture=capture_key(capture)) as draft:
        fixes, corrected = find_fixes(check.fixes), capture
        if check.mesh_scale != 1:
            corrected = MeshSimilarity(check.mesh_scale).apply(corrected)
        if fixes:
            corrected = apply_fixes(corrected, fixes, check.camera_axes)
        write_page(
            draft.folder / TEMPLATE, TEMPLATE,
            verdict=verdict(check), remedy=remedy, numbers=_numbers(check),
            findings=[_finding_rows(one) for one in check.findings], questions=QUESTIONS,
            views=list(_views(capture, corrected, check)), total=len(check.views),
            panoramas=_panoramas(capture, corrected), source=str(capture.source or ""),
            is_corrected=corrected is not capture, before=BEFORE, after=AFTER,
        )  # fmt: skip
        write_manifest(draft.folder / RECORD, {
            "fits": check.fits, "fixes": check.fixes, "mesh_scale": check.mesh_scale,
            "check": check, "settings": settings, "environment": environment_record(),
            **draft.entries(),
        })  # fmt: skip


def verdict(check: Check) -> str:
    """Return the result as one sentence."""
    names = [*([] if check.mesh_scale == 1 else ["another mesh scale"]), *check.fixes]
    is_unclear = any(one.question == "poses" and one.verdict == "unclear" for one in check.findings)
    if names and not is_unclear:
        count = len(names)
        words = "One correction makes" if count == 1 else f"{count} corrections make"
        return f"{words} the capture fit its photographs: {' + '.join(names)}."
    if any(one.verdict == "wrong" for one in check.findings):
        return "The capture does not fit its photographs."
    unclear = [one.question for one in check.findings if one.verdict == "unclear"]
    if any(question in AXES for question in unclear):
        return "The capture may not fit its photographs; the right correction is unclear."
    if unclear:
        titles = [QUESTIONS[question].lower() for question in unclear]
        return f"Axes fit, but results may be wrong for another reason: {', '.join(titles)}."
    fits = "The capture fits its photographs, as far as can be determined"
    if any(one.question == "ignored" for one in check.findings):
        return f"{fits}; ignored effects may bias the results."
    return f"{fits}."


def _numbers(check: Check) -> Iterator[tuple[str, str, str]]:
    """Yield title, mean over the views, and explanation of each measure."""
    before, after = ViewMeans.of(check.views), ViewMeans.of(check.corrected)
    for name, (title, note, _) in MEASURES.items():
        old, new = getattr(before, name), getattr(after, name)
        if old is None and new is None:
            continue
        if check.corrected is not check.views:
            note = f"{_number(new)} after correction; {note}"
        yield title, _number(old), note


def _number(value: float | None, unknown: str = "unknown") -> str:
    return unknown if value is None else f"{value:.2f}"


def _finding_rows(one: Finding) -> dict[str, Any]:
    """Return a finding, its best hypotheses with bar widths, and the count of omitted ones."""
    scores = [hypothesis.score for hypothesis in one.hypotheses]
    low, high = min(scores, default=0.0), max(scores, default=1.0)
    shown = list(one.hypotheses[:ROWS])
    shown += [h for h in one.hypotheses[ROWS:] if not h.fixes]  # always show the uncorrected one
    widths = [3 + 97 * (h.score - low) / max(high - low, 1e-9) for h in shown]
    return {
        "finding": one, "rows": list(zip(shown, widths, strict=True)),
        "left_out": len(one.hypotheses) - len(shown),
    }  # fmt: skip


def _views(
    capture: Capture, corrected: Capture, check: Check
) -> Iterator[tuple[str, PageImage, list[tuple[str, str]]]]:
    """Yield name, outlined picture and measures of each of the worst views."""
    frames = Thumbnails.of(reduce_photographs(capture, PICTURE))
    seen = after = silhouettes(frames)
    if corrected is not capture:
        after = silhouettes(Thumbnails.of(reduce_photographs(corrected, PICTURE)))
    place = {int(view): index for index, view in enumerate(np.flatnonzero(capture.used))}
    better = {one.view: one for one in check.corrected}
    for one in check.worst[:MOST]:
        index = place[one.view]
        image, mask = frames.radiance[index], frames.masks[index]
        picture = tone_mapped(image, after[index] if mask is None else mask)
        picture[~np.isfinite(image).all(axis=2)] = 1.0  # clipped pixels
        _draw_outline(picture, seen[index], BEFORE)
        if corrected is not capture:
            _draw_outline(picture, after[index], AFTER)
        numbers = [
            (word, _change(getattr(one, name), getattr(better[one.view], name)))
            for name, (*_, word) in MEASURES.items()
        ]
        yield one.name, embedded_jpeg(picture), [entry for entry in numbers if entry[1] != "-"]


def _change(before: float | None, after: float | None) -> str:
    old, new = _number(before, "-"), _number(after, "-")
    return old if old == new else f"{old} → {new}"


def _draw_outline(picture: np.ndarray, seen: np.ndarray, color: tuple[float, float, float]) -> None:
    """Draw an outline into a picture, one pixel wide on both sides of the edge."""
    picture[outline(seen) | outline(~seen)] = color


def _panoramas(capture: Capture, corrected: Capture) -> list[tuple[PageImage, str]]:
    """Return panoramas of the captured light and, if it differs, of the corrected light."""
    if emitter_of(capture) is None:
        return []
    shown = [(_panorama(capture), "as captured")]
    return shown if corrected is capture else [*shown, (_panorama(corrected), "corrected")]


def _panorama(capture: Capture) -> PageImage:
    """Draw the light around the object with the cameras as dots.

    Up is the cameras' upward direction. The centre is the viewing direction of the first camera,
    for comparison with the background of its photograph.
    """
    environment = read_environment(emitter_of(capture))
    grid = rasterized(environment)
    poses = np.array([to_world(sensor) for sensor in capture.used_sensors])
    # Mirrored left to right, because the light is seen from inside.
    frame = viewing_frame(up_of_poses(poses), poses[0, :3, 2]) * [[-1], [1], [1]]
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
    return embedded_jpeg(picture, None)

"""``report.html``: self-contained page with a capture and its estimate."""

import dataclasses
import datetime
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import svu_mi
from svu_mi.calibration.light.light_summary import summary_sentences
from svu_mi.capture.capture import Capture
from svu_mi.capture.up_direction import up_direction
from svu_mi.core.io.output_folder import write_page
from svu_mi.core.progress import Stage
from svu_mi.errors import counted
from svu_mi.output import style
from svu_mi.output.estimate_arrays import (
    coverages,
    entropies,
    is_seen,
    known_values,
    label_of,
    open_axes,
)
from svu_mi.output.html import NARROW_SPACE, grouped, page_of, percent
from svu_mi.output.interval_summary import (
    Intervals,
    IntervalSummary,
    picture_intervals,
    sampled_intervals,
)
from svu_mi.output.report import report_pictures, report_plots, summary_text
from svu_mi.output.report.turntable import Turntable
from svu_mi.output.rerender import WORST
from svu_mi.output.run_record import environment_record
from svu_mi.posterior.estimate import Estimate
from svu_mi.recovery.svbrdf_textures import Textures
from svu_mi.recovery.uncertainty.texture_field import field_of_textures

TEMPLATE = "report.html"
FRAMES, SIDE = 12, 400  # number of turntable frames, pixels per side
UNNAMED = ("", "object")  # ids of shapes without a name, and of imported meshes
WARNINGS = 12  # number shown before "more"


def write_report(
    capture: Capture, estimate: Estimate, path: str | Path, *, textures: Textures | None = None,
    title: str | None = None, settings: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> IntervalSummary:  # fmt: skip
    """Write an estimate as one self-contained HTML page.

    The page opens in any browser without a network. Of many photographs, an evenly spaced
    subset is shown and rendered, so that size and time stay small.

    Args:
        capture: Capture of the estimate.
        estimate: Estimate to show; may have no visible texel.
        path: Path of the HTML file. An existing file that is not an unchanged report is renamed to
            ``NAME.before.EXT``, with a warning.
        textures: Recovered textures, such as ``recover(...).textures``, to show and to render for
            comparison with the photographs.
        title: Title of the page; default: the name of the object in its scene, or of the capture's
            folder if the object has none.
        settings: Settings of the caller to list, such as command-line options.
        progress: Callback with (finished parts, all parts).

    Returns:
        Summary of the intervals on the page.

    Raises:
        OutputError: the file cannot be written.

    Example:
        >>> summary = svu.write_report(capture, estimate, "report.html", title="Vase")
        >>> sorted(summary.known_part)
        ['base_color', 'metallic', 'roughness']
    """
    report = progress or Stage().update
    table = Turntable.around(capture, FRAMES, SIDE)
    intervals = picture_intervals(estimate, report_pictures.MAP_SIDE)
    capture = dataclasses.replace(capture, warnings=_shared(capture, settings or {}))
    shown = _pictures(capture, estimate, textures, table, intervals, report)
    intervals = sampled_intervals(estimate)  # as in the summaries of other commands
    summary = IntervalSummary.of(estimate, intervals)
    today = datetime.date.today()
    page = page_of(
        TEMPLATE,
        title=title or _object_name(capture), date=f"{today.day} {today:%B %Y}",
        summary=_summary(capture, estimate, intervals, summary, table),
        histogram=report_plots.entropy_histogram(estimate),
        marginals=list(report_plots.marginal_plots(estimate)),
        given=[(name, _setting_text(value)) for name, value in (settings or {}).items()],
        **shown, **_settings(capture, estimate), **_environment(estimate.timings),
    )  # fmt: skip
    write_page(Path(path), page)
    report(5, 5)
    return summary


def _object_name(capture: Capture) -> str:
    """Return the id of the object, or the name of the capture's folder if the id is no name."""
    name = str(capture.shape.id())
    is_named = name not in UNNAMED and not name.startswith("_")
    return name if is_named or not capture.source else capture.source.resolve().name


def _pictures(
    capture: Capture, estimate: Estimate, textures: Textures | None, table: Turntable,
    intervals: Intervals, report: Callable[[int, int], None],
) -> dict[str, Any]:  # fmt: skip
    """Return thumbnails, maps, textures and errors as variables of the template."""
    thumbnails, left_out = report_pictures.thumbnails(capture, estimate)
    frames = list(report_pictures.turntable_pictures(table, estimate))
    report(1, 5)
    maps, recovered = report_pictures.map_pictures(table, estimate, intervals), []
    report(2, 5)
    if textures is not None:
        field = field_of_textures(textures, estimate, capture.mesh)
        recovered = report_pictures.texture_maps(table, estimate, textures, field)
    report(3, 5)
    turned = [frame[0] for frame in frames]
    examples = list(report_plots.example_texels(table, estimate, turned))
    report(4, 5)
    return {
        "count": capture.count, "used": sum(capture.used), "thumbnails": thumbnails,
        "left_out": left_out, "light": _light(capture), "frames": frames, "maps": maps,
        "recovered": recovered, "textured": textures is not None, "examples": examples,
        "errors": _errors(capture, estimate, textures), "error_end": WORST,
        "error_colormap": style.DIFFERENCE_COLORMAP, "colors": style.SETTLED_COLORS,
        "unseen": style.UNSEEN, "color": estimate.posterior.channels == 3,
        "skipped": summary_text.skipped_sentences(estimate),
        "warnings": capture.warnings[:WARNINGS], "more_warnings": capture.warnings[WARNINGS:],
    }  # fmt: skip


def _shared(capture: Capture, settings: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the warnings without local folders, as pages are shared."""
    sentences = list(capture.warnings)
    for path in (capture.source, *settings.values()):
        if isinstance(path, Path) and path.name:
            inside = [sentence.replace(f"{path}{os.sep}", "") for sentence in sentences]
            sentences = [sentence.replace(str(path), path.name) for sentence in inside]
    return tuple(sentences)


def _light(capture: Capture) -> dict[str, Any] | None:
    """Return maps and text of an estimated light; None if the light was given."""
    light, up = capture.found_light, up_direction(capture)
    if light is None:
        return None
    sentences = list(summary_sentences(light, up))
    return {"maps": report_pictures.light_maps(light, up), "sentences": sentences}


def _errors(
    capture: Capture, estimate: Estimate, textures: Textures | None
) -> dict[str, Any] | None:
    grey = textures is None and estimate.posterior.channels == 1
    if textures is None and is_seen(estimate).any():
        textures = report_pictures.most_probable_textures(estimate)
    return None if textures is None else report_pictures.render_errors(capture, textures, grey)


def _summary(
    capture: Capture, estimate: Estimate, intervals: Intervals,
    summary: IntervalSummary, table: Turntable,
) -> dict[str, Any]:  # fmt: skip
    """Return the variables of the page's head."""
    seen = is_seen(estimate)
    entropy = entropies(estimate)[seen]
    views = float(np.median(coverages(estimate)[seen])) if len(entropy) else 0
    width, height = estimate.texels.resolution
    return {
        "seen": summary.seen_part,
        "settled": [
            (label_of(name), summary_text.WidthShares.of(estimate, intervals, name),
             f"±{summary.median_half_width[name]:.2f}")
            for name in summary.known_part
        ],
        "all_settled": summary.all_known_part, "withheld": summary.withheld and summary.sentence(),
        "tolerance": f"±{summary.tolerance:g}", "roughly": f"±{summary_text.ROUGHLY:g}",
        "level": f"{100 * summary.level:g}{NARROW_SPACE}%",
        "cell": f"{max(summary.cell_width.values(), default=0):.2f}",
        "coarse": [label_of(name) for name in summary.cell_width],
        "texture": f"{width} × {height}",
        "predicted": estimate.prediction_sentence,
        "direction": summary_text.facing_direction(estimate, ~seen, table.up),
        "numbers": [
            ("Photographs used", grouped(sum(capture.used)), f"of {grouped(capture.count)}"),
            ("Points of the surface", grouped(len(seen)),
             f"in a texture of {width} × {height}"),
            ("Seen", percent(summary.seen_part),
             f"of the surface; in {counted(views, 'photograph')} each (median)"),
            ("Mean entropy", f"{entropy.mean():.2f}" if len(entropy) else "–",
             f"of the points seen: {style.ENTROPY_ENDS}"),
        ],
        "bins": grouped(int(np.prod(estimate.posterior.grid.shape))),
        "parameters": [label_of(name) for name in open_axes(estimate)],
    }  # fmt: skip


def _settings(capture: Capture, estimate: Estimate) -> dict[str, Any]:
    """Return the settings of the estimate as table rows."""
    preset = dataclasses.asdict(estimate.preset)
    width, height = estimate.texels.resolution
    sizes = sorted({f"{image.shape[1]} × {image.shape[0]}" for image in capture.images})
    return {
        "settings": [
            ("Method", estimate.method),
            ("Preset", preset.pop("name")),
            ("Cells of the grid",
             " × ".join(f"{len(v)} {label_of(n)}" for n, v in open_axes(estimate).items())),
            *((f"Known {label_of(n)}", f"{x:g}") for n, x in known_values(estimate).items()),
            ("Texture", f"{width} × {height}"),
            ("Photographs", f"{', '.join(sizes[:4])}{', …' if len(sizes) > 4 else ''} pixels"),
        ],
        "switches": [(name, _setting_text(value)) for name, value in preset.items()],
    }  # fmt: skip


def _environment(timings: Mapping[str, float]) -> dict[str, Any]:
    """Return times, versions and machine as table rows."""
    environment = environment_record()
    machine = {
        "Platform": environment["platform"], "Mitsuba variant": environment["variant"],
        "Threads": environment["threads"], "LLVM": environment["llvm"]["version"],
    }  # fmt: skip
    return {
        "timings": [(stage, f"{seconds:.2f}{NARROW_SPACE}s")
                    for stage, seconds in timings.items() if np.isfinite(seconds)],
        "seconds": f"{np.nansum(list(timings.values())):.1f}",
        "version": svu_mi.__version__,
        "versions": [(name, value) for name, value in environment["versions"].items() if value],
        "machine": [(name, value or "–") for name, value in machine.items()],
    }  # fmt: skip


def _setting_text(value: Any) -> str:
    """Format a setting; paths are reduced to their name, because pages are shared."""
    if isinstance(value, Path):
        return value.name or str(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple | list):
        return ", ".join(map(_setting_text, value)) or "–"
    if isinstance(value, str) and "=" in value:  # value of -D
        key, _, text = value.partition("=")
        return f"{key}={_setting_text(Path(text)) if text else ''}"
    return "–" if value is None else str(value)

"""Files of ``svu inpaint``: filled textures, overview page, summary sentences."""

import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import svu_mi
from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import capture_key
from svu_mi.capture.scene import to_world
from svu_mi.capture.tonemap import ObjectView, object_only_scene
from svu_mi.core.io.exr import write_exr
from svu_mi.core.io.output_folder import writing
from svu_mi.output import style
from svu_mi.output.estimate_arrays import label_of
from svu_mi.output.html import percent
from svu_mi.output.maps import padded_image, write_field
from svu_mi.output.panels import draw_look, draw_map, fully_seen, map_colors
from svu_mi.output.run_record import RECORD, RunInfo, inputs_record, write_run
from svu_mi.output.style import Block, Panel
from svu_mi.output.texture_files import write_scene
from svu_mi.output.texture_samples import texture_colors
from svu_mi.parameters import NAMES
from svu_mi.recovery.inpaint.fill_result import Filled, ModelReport
from svu_mi.recovery.uncertainty.texture_field import TextureField

MASK, PAGE = "filled.exr", "filled.png"
LIKE = "Uncertain texels, filled from similar ones"
INVENTED = "Uncertain texels, filled by {}"
CELL = 3.2  # inches


def write_filled(
    capture: Capture, before: TextureField, result: Filled, folder: str | os.PathLike[str],
    run: RunInfo | None = None, *, pictures: bool = True,
) -> None:  # fmt: skip
    """Write textures, ``recovered.xml``, ``uncertainty.exr``, ``filled.exr`` and ``run.json``.

    ``before`` contains the textures before filling. ``pictures`` adds ``filled.png``.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    run = run or RunInfo()
    about = {"svu:version": svu_mi.__version__, "svu:method": "inpaint"}
    model = result.invented
    with writing(folder, "inpaint", RECORD, capture=capture_key(capture)) as draft:
        write_scene(capture, result.textures, draft.folder, attributes=about)
        write_field(result.field, draft.folder, about)
        masks = {"Y": result.filled} | ({} if model is None else {"model": model.reached})
        write_exr(draft.folder / MASK, {
            name: padded_image(result.field, mask.astype(np.float32), fill=0)
            for name, mask in masks.items()
        }, about)  # fmt: skip
        if pictures:
            _draw_page(capture, before, result, draft.folder / PAGE)
        record = {
            "inputs": inputs_record(capture), "settings": {},
            "result": {"filled": int(result.filled.sum()), "likeness": result.likeness,
                       "errors": result.errors, **({} if model is None else _model_record(model))},
        }  # fmt: skip
        write_run(draft, record, run)


def fill_sentences(result: Filled) -> Iterator[str]:
    """Yield sentences on the share of filled texels, methods and errors."""
    part = result.filled.mean() if len(result.filled) else 0.0
    if not result.filled.any():
        yield "All texels are seen with low uncertainty; nothing was filled."
        return
    yield f"{percent(part)} of the texels filled."
    if result.invented is not None:
        yield from _invented_sentences(result.invented, result)
    for name in result.field.names:
        yield (
            f"{label_of(name).capitalize()}: RMS error {result.errors[name]:.2f} in a test on seen "
            f"texels; weights of predictors: {result.likeness[name]}."
        )


def _invented_sentences(model: ModelReport, result: Filled) -> Iterator[str]:
    """Yield sentences on a generative model: share of texels, errors on seen texels."""
    part = model.reached.sum() / result.filled.sum()
    by = f"by {model.model}; licence of its weights: {model.licence}"
    yield f"{percent(part)} of the filled texels {by}."
    for answer in model.answers:
        number = len(answer.pictures)
        kind = {"photographs": "photograph", "renders": "render"}[answer.source]
        off = ", ".join(
            f"{label_of(name)} {error:.2f} ({answer.likeness[name]:.2f})"
            for name, error in answer.errors.items()
        )
        yield (
            f"From {number} {kind}{'' if number == 1 else 's'}. RMS error in a test on seen texels "
            f"(in brackets: filling from similar texels): {off}."
        )
    if model.reached.sum() < result.filled.sum():
        yield "Texels that no picture shows well are filled from similar ones:"


def _model_record(model: ModelReport) -> dict[str, Any]:
    """Return the record of a generative model for ``run.json``."""
    answers = [
        {"source": answer.source, "pictures": list(answer.pictures),
         "reached": int(answer.reached.sum()), "errors": answer.errors,
         "likeness": answer.likeness}
        for answer in model.answers
    ]  # fmt: skip
    return {"model": {"title": model.model, "licence": model.licence, "answers": answers}}


def _draw_page(capture: Capture, before: TextureField, result: Filled, path: Path) -> None:
    """Draw every parameter before and after filling, as seen from ``_best_sensor``."""
    rows = ("before", "after", "standard deviation")
    model, texels = result.invented, before.texels
    heading = LIKE if model is None else INVENTED.format(model.model)
    look = ObjectView.at(object_only_scene(capture), capture.sensors[_best_sensor(capture, result)])
    everywhere = fully_seen(texels)
    mask = partial(draw_map, estimate=everywhere, colormap=style.GREY)
    masks = {"before": ("Filled texels", partial(mask, values=result.filled))}
    if model is not None:
        masks["after"] = ("Filled by the model", partial(mask, values=model.reached))
    panels: list[Panel | None] = []
    for row in rows:
        for name in NAMES:
            if row == "standard deviation":
                sd = result.field.sd(name).reshape(texels.count, -1).max(axis=1)
                shown = map_colors(everywhere, sd, limits=(0, style.WIDEST_SD))
            else:
                field = before if row == "before" else result.field
                shown = texture_colors(texels, field.textures, name)
            scale = f" (yellow: {style.WIDEST_SD:g})" if row == "standard deviation" else ""
            title = f"{label_of(name).capitalize()}, {row}{scale}"
            panels.append((title, partial(draw_look, look=look, colors=shown)))
        panels.append(masks.get(row))
    height, columns = CELL * len(rows) + 1.1, len(NAMES) + 1
    block = Block(
        panels=panels, shape=(len(rows), columns), box=(0.01, 0.99, 0.01, 1 - 0.85 / height),
        space=(0.04, 0.16), anchor="NW",
    )  # fmt: skip
    style.write_page(path, (CELL * columns, height), heading, [], [block])


def _best_sensor(capture: Capture, result: Filled) -> int:
    """Return the index of the sensor that the largest number of filled texels face."""
    texels = result.field.texels
    position, normal = (np.array(x)[:, result.filled] for x in (texels.position, texels.normal))
    eyes = [to_world(sensor)[:3, 3] for sensor in capture.sensors]
    facing = [int((((eye[:, None] - position) * normal).sum(axis=0) > 0).sum()) for eye in eyes]
    return int(np.argmax(facing))

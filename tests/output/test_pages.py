"""Pages as PNG: large percentages, order of panels, units, and texts that do not overlap."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.axis import Axis
from matplotlib.text import Text

import svu_mi as svu
from svu_mi.light.latlong import directions
from svu_mi.output import guidance_page, light_page, object_views, overview, style
from svu_mi.output.interval_summary import IntervalSummary
from svu_mi.output.recovery_page import write_recovery_overview
from svu_mi.output.rerender import RenderComparison
from svu_mi.posterior.prediction import HeldOutPrediction
from svu_mi.recovery.svbrdf_textures import uniform_textures


@pytest.fixture
def drawn(monkeypatch):
    """Figures of the pages, instead of their files."""
    figures = []
    monkeypatch.setattr(style, "save_figure", lambda figure, _: figures.append(figure))
    return figures


def texts(figure):
    return [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip()]


def overlaps(figure):
    """Return pairs of texts that share pixels; ticks, which axes hide themselves, are left out."""
    figure.draw_without_rendering()
    found = texts(figure)  # creates ticks beyond the limits
    marks = [tick for axis in figure.findobj(Axis) for tick in (*axis.majorTicks, *axis.minorTicks)]
    ticks = {label for tick in marks for label in (tick.label1, tick.label2)}
    boxes = [(t.get_text(), t.get_window_extent()) for t in found if t not in ticks]
    return [(a, b) for (a, x), (b, y) in itertools.combinations(boxes, 2) if x.overlaps(y)]


def place(figure, start):
    """Return the upper end of the axes whose title begins with ``start``."""
    return next(a.get_position().y1 for a in figure.axes if a.get_title("left").startswith(start))


def test_the_overview_begins_with_the_known_shares(vase, drawn):
    summary = IntervalSummary.of(vase.estimate)
    shares = {"roughness": 0.034, "metallic": 1.0, "base_color": 0.998}
    summary = replace(summary, known_part=shares, cell_width={"metallic": 0.25})
    overview.write_overview(vase.capture, vase.estimate, "unused", summary)
    large = [t.get_text() for t in texts(drawn[0]) if t.get_size() > 30]
    assert large == ["3 %", "100 %", ">99 %"]
    assert not overlaps(drawn[0])
    assert max(t.get_window_extent().x1 for t in texts(drawn[0])) <= drawn[0].bbox.x1
    wrong = replace(vase.estimate, prediction=HeldOutPrediction(0.12, 0.61))
    withheld = replace(summary, known_part={}, withheld="the light was estimated")
    overview.write_overview(vase.capture, vase.estimate, "unused", withheld)
    overview.write_overview(vase.capture, wrong, "unused", summary)
    for figure, told in zip(drawn[1:], (withheld, wrong.prediction), strict=True):
        assert told.sentence() in [t.get_text() for t in texts(figure)]
        assert max(t.get_size() for t in texts(figure)) < 30


def test_the_first_photograph_is_a_bright_one(vase):
    images = [np.full((36, 48, 3), 0.1, np.float32) for _ in range(4)]
    for image, bright in zip(images, (5, 20, 30, 40), strict=True):
        image[:, :bright] = 1  # columns as bright as the highlights
    capture = replace(vase.capture, images=tuple(images), masks=(None,) * 4)
    assert object_views.distant_views(capture, [10, 9, 9, 7], 1) == [2]  # 3 sees too little


def test_the_page_of_a_recovery_begins_with_the_comparison(vase, drawn):
    textures = uniform_textures(vase.texels)
    recovery = SimpleNamespace(
        method="sh", texels=vase.texels, textures=textures, losses=(), settings={},
        coverage=vase.estimate.coverage, image=lambda name: np.array(getattr(textures, name)),
    )  # fmt: skip
    image, inside = np.full((8, 8, 3), 0.5, np.float32), np.ones((8, 8), bool)
    one = RenderComparison(
        view=1, name="IMG_8.JPG", photograph=image, exact=inside, render=image, inside=inside,
        relit=image,
    )  # fmt: skip
    pair = [one, replace(one, view=2, name=f"IMG_{'9' * 99}.JPG")]
    write_recovery_overview(vase.capture, recovery, pair, "unused", vase.estimate)
    assert place(drawn[0], f"Photograph …{'9' * 13}.JPG") > place(drawn[0], "Roughness, sd")
    assert not overlaps(drawn[0])
    assert place(drawn[0], "Photograph IMG_8.JPG")


def test_gains_of_proposals_are_percent_of_the_entropy(vase, drawn):
    guidance = svu.next_best_view(
        vase.estimate, svu.Candidates.around(vase.capture, 6), 2, texels=200
    )
    proposal = replace(guidance.proposals[0], gain=0.03, error=0.002, sees=0.25, new=0.0)
    guidance = replace(guidance, entropy=0.6, proposals=(proposal, guidance.proposals[1]))
    looks, maps = guidance_page.proposal_views(vase.capture, guidance), guidance.gain_maps()
    guidance_page.write_guidance_overview(
        vase.capture, vase.estimate, guidance, maps, looks, "unused"
    )
    shown = "lowers mean entropy by 5.0 ± 0.3 %\nsees 25 % of the texels"
    assert shown in [t.get_text() for t in texts(drawn[0])]
    assert not overlaps(drawn[0])
    right = max(a.get_position().x1 for a in drawn[0].axes if a.get_position().y1 < 0.45)
    assert right > 0.75  # two proposals fill the width


@pytest.mark.parametrize(
    ("up", "ahead", "right"),
    [((0, 1, 0), (0, 0, -1), (1, 0, 0)), ((0, 0, 1), (0, 1, 0), (1, 0, 0)),
     ((0, -1, 0), (0, 0, -1), (-1, 0, 0))],
)  # fmt: skip
def test_maps_of_light_stand_upright(up, ahead, right):
    world = directions(256, 129)  # a map of its own directions
    drawn = light_page.upright(world, np.array(up, float))
    places = drawn[0, 9], drawn[64, 0], drawn[64, 64], drawn[128, 9]
    expected = up, ahead, right, -np.array(up)
    np.testing.assert_allclose(places, expected, atol=0.03)  # a pixel
    axes = style.new_figure(4, 2).add_subplot()
    light_page._label_directions(axes, np.array(up, float))
    labels = [label.get_text() for label in axes.get_xticklabels()]
    letters = ["XYZ"[np.abs(x).argmax()] for x in (ahead, right)]
    assert [label[-1] for label in labels[:2]] == letters

"""Pages: one file, nothing from elsewhere, readable on a telephone."""

from __future__ import annotations

import re
import socket

import numpy as np
import pytest

from svu_mi.errors import OutputError
from svu_mi.output import html

TEMPLATE = """{% extends "base.html" %}
{% import "parts.html" as parts %}
{% block title %}{{ name }}{% endblock %}
{% block body %}
<h1>{{ name }}</h1>
{{ parts.headline([("Views", 3, "of 4")]) }}
{{ parts.turntable(frames, "Turn") }}
{{ parts.table(("File", "Pixels"), rows, (1,)) }}
{{ raw | safe }}
{% endblock %}
"""
NAME = """<b onclick="x">&"quoted"' — Wäsche</b>"""


@pytest.fixture(scope="module")
def server():
    """A server that would notice who asks."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.setblocking(False)
        yield listening


@pytest.fixture(scope="module")
def written(tmp_path_factory, server):
    """A page of all parts; its template smuggles in a script, a picture and a style sheet."""
    path = tmp_path_factory.mktemp("pâge & <b>") / "page.html"
    rng = np.random.default_rng(71)
    photograph = html.embedded_jpeg(rng.uniform(size=(30, 400, 3)))
    drawing = html.embedded_png(rng.uniform(size=(20, 10, 4)))
    frames = [(photograph, "one", NAME), (drawing, "two", "")]
    elsewhere = f"http://127.0.0.1:{server.getsockname()[1]}"
    raw = (
        "<script>document.title = 'taken over'</script>"
        f"<img src='{elsewhere}/x.png'><link rel=stylesheet href='{elsewhere}/x.css'>"
    )
    template = html._environment().from_string(TEMPLATE)
    html.write_page(path, template, name=NAME, frames=frames, rows=[("x" * 300, 1e9)], raw=raw)
    return path


def test_text_is_escaped(written):
    text = written.read_text(encoding="utf-8")
    assert NAME not in text and "&lt;b onclick=" in text and "Wäsche" in text


def test_pictures_are_inside_and_small(written):
    text = written.read_text(encoding="utf-8")
    assert re.findall(r'data:image/\w+|width="\d+" height="\d+"', text) == [
        "data:image/jpeg", 'width="240" height="18"', "data:image/png", 'width="10" height="20"',
    ]  # fmt: skip


def test_a_picture_with_nan_is_refused():
    with pytest.raises(OutputError, match="NaN"):
        html.embedded_png(np.full((2, 2, 3), np.nan))
    with pytest.raises(OutputError, match="empty"):
        html.embedded_jpeg(np.zeros((0, 2, 3)))


def test_percent_does_not_round_to_nothing_or_all():
    words = {0: "0", 0.004: "under 1", 0.006: "1", 0.5: "50", 0.996: "over 99", 1: "100"}
    assert {p: html.percent(p) for p in words} == {p: f"{w}\u202f%" for p, w in words.items()}


def test_pages_load_nothing_and_run_only_their_scripts(browser, written, server):
    shown = browser.open(written)
    assert len(shown.requests) == 2  # tried, and blocked
    with pytest.raises(BlockingIOError):
        server.accept()
    assert shown.evaluate("document.title") == NAME
    assert sum("Content Security Policy" in text for text in shown.complaints) == 3
    assert shown.evaluate("[...document.images].map(i => i.naturalWidth)") == [240, 10, 0]
    shown.close()


@pytest.mark.parametrize("width", [1280, 400])
@pytest.mark.parametrize("scripts", [True, False])
def test_nothing_is_wider_than_the_page(browser, written, width, scripts):
    """A long table scrolls in its box; without scripts both frames of the turntable are there."""
    shown = browser.open(written, width, scripts=scripts)
    assert shown.evaluate("innerWidth") == width and shown.overflow == 0
    visible = "f => f.checkVisibility({visibilityProperty: true})"
    frames = f"[...document.querySelectorAll('.frames > *')].filter({visible}).length"
    assert shown.evaluate(frames) == (1 if scripts else 2)
    shown.close()


def test_the_turntable_turns(browser, written):
    shown = browser.open(written)
    slide = """const s = document.querySelector('.control input'); s.value = 1;
        s.dispatchEvent(new Event('input')); document.querySelector('.shown img').alt"""
    assert shown.evaluate(slide) == "two"
    shown.close()


def test_dark_readers_get_dark_pages(browser, written):
    color = "getComputedStyle(document.body).backgroundColor"
    for dark in (False, True):
        shown = browser.open(written, dark=dark)
        red = int(re.search(r"\d+", shown.evaluate(color)).group())
        assert red < 64 if dark else red > 192
        shown.close()

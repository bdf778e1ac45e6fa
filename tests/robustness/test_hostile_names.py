"""Names from captures run nothing in pages, in the viewer or in plots, and appear as they are."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from support.browser import Browser
from support.helpers import memory_capture, render_ball

import svu_mi as svu
from svu_mi.cli.batch.batch_page import write_index
from svu_mi.cli.batch.runner import Outcome
from svu_mi.core.identifiers import markdown_text
from svu_mi.output.check_page import write_check
from svu_mi.output.relight_page import write_relit_page
from svu_mi.output.style import new_figure, save_figure
from svu_mi.recovery.relighting import RelitView

# Each would set ``ran`` in the page, break the syntax of Markdown, or not be valid mathtext.
NAMES = (
    "<img src=x onerror=window.ran=1>.png",
    "<iframe srcdoc='<script>parent.ran=1</script>'>.png",
    "{window.ran=1}.png",
    "{(()=>{window.ran=1})()}",
    "<script>window.ran=1</script>.png",
    "</script><script>window.ran=1</script>",
    "![x](javascript:window.ran=1).png",
    "[x](javascript:window.ran=1) <svg onload=window.ran=1>",
    '"onmouseover="window.ran=1" x="',
    r"$\frac{1$_^`code`**bold**.png",
)
RAN = "typeof window.ran !== 'undefined'"


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    paint = {"type": "principled", "base_color": {"type": "rgb", "value": [0.6, 0.3, 0.2]}}
    light = {"type": "constant", "id": "light"}
    shot = render_ball(tmp_path_factory.mktemp("ball"), light, paint, 10, (32, 32), 4)
    return memory_capture(shot.scene, list(shot.images), shot.sensors, names=NAMES)


@pytest.fixture(scope="module")
def estimate(capture):
    return svu.estimate(capture, svu.texels(capture.mesh, 16), preset="fast")


def nothing_ran(browser, path):
    """Open a page, wait for its events, and return its text."""
    page = browser.open(path)
    page.evaluate("new Promise(done => setTimeout(done, 300))")
    assert not page.evaluate(RAN), path
    text = page.evaluate("document.documentElement.innerText")
    page.close()
    return text


@pytest.mark.slow
def test_pages_run_no_name(capture, estimate, browser, tmp_path):
    svu.write_report(capture, estimate, tmp_path / "report.html", title=NAMES[4])
    assert NAMES[0] in nothing_ran(browser, tmp_path / "report.html")
    write_check(capture, svu.check(capture), tmp_path / "check", remedy=NAMES[1])
    nothing_ran(browser, tmp_path / "check" / "check.html")
    outcomes = [Outcome(name, tmp_path / "x", sentence=name) for name in NAMES]
    write_index(tmp_path, outcomes)
    assert all(name in nothing_ran(browser, tmp_path / "index.html") for name in NAMES[:3])


@pytest.mark.slow
def test_the_viewer_runs_no_name(capture, estimate, tmp_path):
    pytest.importorskip("viser")
    from svu_mi.output.viewer.viewer import Viewer

    viewer = Viewer(capture, estimate, port=0)
    browser = Browser(tmp_path, "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    seen = ", ".join(NAMES)
    try:
        page = browser.open(viewer.url, 900, 700)
        place = np.array(estimate.texels.position).T[0]
        viewer.pick(tuple(3 * place), tuple(-place))
        assert viewer.picked is not None and viewer.picked.seen_by
        names = [NAMES[view] for view in viewer.picked.seen_by[:3]]
        # Also all names at once, which no texel is seen by.
        viewer._text.content += f"\n\n{', '.join(map(markdown_text, NAMES))}"
        text = "document.body.innerText"
        page.evaluate(f"""new Promise((done, failed) => {{
            const end = Date.now() + 20000;
            const wait = () => {text}.includes({names[0]!r}) ? done()
                : Date.now() > end ? failed(Error({text})) : setTimeout(wait, 100);
            wait(); }})""")
        page.evaluate("new Promise(done => setTimeout(done, 500))")
        assert not page.evaluate(RAN)
        shown = page.evaluate(text)
        assert seen in shown and all(name in shown for name in names)
    finally:
        browser.close()
        viewer.stop()


def test_plots_show_names_as_text(capture, tmp_path):
    picture = np.full((8, 8, 3), 0.5)
    inside = np.ones((8, 8), bool)
    view = RelitView(picture=picture, mean=picture, sd=picture, inside=inside)
    write_relit_page([view] * 6, NAMES[-6:], tmp_path / "relight.png", [NAMES[-1]])
    figure = new_figure(3, 1)
    axes = figure.add_subplot()
    axes.set_yticks([0, 1], [NAMES[-1], "$a$"])
    axes.set_title(NAMES[-1])
    axes.annotate(NAMES[-1], (0, 0))
    save_figure(figure, tmp_path / "names.png")
    assert Image.open(tmp_path / "names.png").size == (300, 100)


def test_markdown_of_a_name_has_no_syntax():
    assert markdown_text("view_01 {a}<b>*") == "view&#95;01 &#123;a&#125;&#60;b&#62;&#42;"
    assert markdown_text("Größe 2.exr") == "Größe 2.exr"
    assert "\n" not in markdown_text("a\nimport b")

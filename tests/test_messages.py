"""Messages name what their reader has typed or called."""

from __future__ import annotations

import re

import numpy as np
import pytest
from helpers import fails, lettered, overlapping_balls, write_known, write_scene

import svu_mi as svu
from svu_mi.errors import OptionError, SvuError
from svu_mi.output.textures import write_textures
from svu_mi.posterior.streaming import log_prior

pytestmark = pytest.mark.usefixtures("variant")  # svu chooses one


def test_an_error_says_the_same_to_both_but_for_the_call():
    assert SvuError("estimate(): the prior is bad.").shell == "the prior is bad."
    both = OptionError("Use trust=True.", shell="Use --trust.")
    assert (str(both), both.shell) == ("Use trust=True.", "Use --trust.")


@pytest.mark.filterwarnings("ignore::svu_mi.errors.SvuWarning")
def test_overlapping_charts_name_the_option_or_the_argument(tmp_path, capsys):
    scene = write_scene(tmp_path, **overlapping_balls())
    line = fails(
        capsys, "entropy", scene, "--render", "--spp", 1, "--resolution", 32, "-o", tmp_path / "out"
    )
    assert re.fullmatch(
        r"svu: Shape 'ball' has overlapping UV charts: \d+ of \d+ texels lie on several surface "
        r"points; use --unwrap, or lay out UVs without overlap\.", line,
    )  # fmt: skip
    mesh = svu.render_capture(scene, spp=1).mesh
    with pytest.raises(SvuError, match=r"use load_capture\(unwrap=True\), or lay out"):
        svu.texels(mesh, 32)


def test_a_report_says_what_a_folder_is_that_has_no_textures(shot, tmp_path, capsys):
    """As svu export does; and it takes the resolution of the textures."""
    known = tmp_path / "known"
    write_known(known, 20, 30)
    words = ("report", shot, "-o", tmp_path / "report.html", "--recovered")
    assert fails(capsys, *words, known) == (
        f"svu: {known}: has no base_color.exr, roughness.exr, metallic.exr, so it is not a result "
        "of svu recover but of svu entropy; run svu recover on the same capture, and give what it "
        "writes."
    )
    (tmp_path / "textures").mkdir()
    write_textures(lettered(32, 16), tmp_path / "textures")
    assert fails(capsys, *words, tmp_path / "textures", "--resolution", 64) == (
        f"svu: {tmp_path / 'textures'}: the textures have 32 x 16 texels; omit --resolution, which "
        "is theirs."
    )
    assert fails(capsys, *words, tmp_path / "none") == (
        f"svu: {tmp_path / 'none'}: no such folder; give one that svu recover wrote."
    )


@pytest.mark.parametrize(
    "prior", ["uniform", [[1, 2], [3]], {"roughness": 1}, object(), 1j * np.ones(8), [None] * 8]
)
def test_a_prior_that_is_no_numbers_is_a_sentence(prior):
    kind = type(prior).__name__
    with pytest.raises(OptionError) as error:
        log_prior(prior, (8, 8, 8), "estimate()")
    assert str(error.value) == (
        f"estimate(): the prior must be numbers, (8, 8, 8) or (8,), got a {kind}."
    )


def test_what_is_no_capture_estimate_or_candidate_is_a_sentence(vase):
    with pytest.raises(SvuError, match=r"check\(\): a capture is needed, got a str; read one with"):
        svu.check("cap")
    with pytest.raises(SvuError, match=r"next_best_view\(\): an estimate is needed, got a str;"):
        svu.next_best_view("cap")
    with pytest.raises(SvuError, match="candidates must be Candidates or sensors, got 100; place"):
        svu.next_best_view(vase.estimate, 100, 5)

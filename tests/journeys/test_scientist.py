"""The first hour of a scientist, in a shell and in a notebook."""

from __future__ import annotations

import re

import pytest
from support.journey import done

FOUND = re.compile(
    r"\d+ % of the surface area seen, mean entropy 0\.\d\d\. Roughness known to ±0\.05 on .* "
    r"of the surface area seen, metallic on .*, base colour on .* \(90 % intervals of .*\)\."
)


@pytest.mark.slow
def test_last_lines_summarize_the_result(desk):
    """Where people look: not only where it was written."""
    said = done("entropy capture --resolution 32 -o out/found", desk)
    assert said.out[-2] == "Wrote out/found"
    assert FOUND.fullmatch(said.out[-1]), said
    said = done("report capture --resolution 32 -o found.html", desk)
    assert said.out[-2] == "Wrote found.html"
    assert FOUND.fullmatch(said.out[-1]), said

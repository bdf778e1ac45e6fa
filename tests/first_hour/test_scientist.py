"""The first hour of a scientist, in a shell and in a notebook."""

from __future__ import annotations

import re

import pytest
from hour import done

from svu_mi.exr import read_exr

FOUND = re.compile(
    r"\d+ % of the surface seen, mean entropy 0\.\d\d\. Roughness known to ±0\.05 on .* of the "
    r"surface seen, metallic on .*, base colour on .* \(90 % intervals\)\."
)
@pytest.mark.slow
def test_the_last_lines_say_what_was_found(desk):
    """Where people look: not only where it was written."""
    said = done("entropy capture --resolution 32 -o out/found", desk)
    assert said.out[-2] == "Wrote out/found"
    assert FOUND.fullmatch(said.out[-1]), said
    said = done("report capture --resolution 32 -o found.html", desk)
    assert said.out[-2] == "Wrote found.html"
    assert FOUND.fullmatch(said.out[-1]), said


@pytest.mark.slow
def test_recovery_shows_the_entropy_and_the_export_takes_it(desk):
    said = done("recover capture --resolution 32 --no-pictures -o out/known", desk)
    assert FOUND.fullmatch(said.out[-1]), said
    entropy = read_exr(desk / "out" / "known" / "entropy.exr")["Y"]
    assert 0 < entropy.min() < 0.9 and entropy.max() == 1
    assert not list((desk / "out" / "known").glob("*.png"))
    done("export out/known -o out/carried", desk)
    carried = read_exr(desk / "out" / "carried" / "textures" / "entropy.exr")["Y"]
    assert carried.min() == pytest.approx(entropy.min())
    assert (desk / "out" / "carried" / "entropy.glb").is_file()


@pytest.mark.slow
def test_what_was_not_estimated_is_said(desk):
    """A normal map, and a grey table under the object."""
    scene = (desk / "scenes" / "vase" / "vase.xml").read_text()
    table = (
        '<shape type="rectangle" id="table"><transform name="to_world"><scale x="3" y="3"/>'
        '<rotate x="1" angle="-90"/><translate y="-0.95"/></transform>'
        '<bsdf type="diffuse"/></shape></scene>'
    )
    (desk / "scenes" / "vase" / "table.xml").write_text(scene.replace("</scene>", table))
    coat = '<float name="clearcoat" value="1"/></bsdf>'
    (desk / "scenes" / "vase" / "coated.xml").write_text(scene.replace("</bsdf>", coat))
    where = "-D light=window -D resolution=64 --images capture --resolution 32 --no-pictures"
    said = done(f"entropy scenes/vase/table.xml {where} -o out/table", desk)
    assert said.warnings == [
        "Shape 'table' reflects light onto 'vase', which svu does not account for: base colours "
        "near it will be too bright; put something black around the object when it is "
        "photographed."
    ]
    said = done(f"entropy scenes/vase/coated.xml {where} -o out/coated", desk)
    assert said.warnings == [
        "Shape 'vase' has clearcoat 1, which svu does not account for: if the photographs show "
        "that, roughness and base colour will be off."
    ]

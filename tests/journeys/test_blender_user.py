"""The first hour of somebody with a mesh, poses and pictures of other programs."""

from __future__ import annotations

import pytest
from support.journey import done

FITS = "The capture fits its photographs, as far as can be determined."


@pytest.mark.slow
def test_a_capture_needs_no_light_to_look_at_its_poses(shots):
    """No map of the light: are the poses right? And then it is found."""
    said = done("import blender --mesh scan.ply -o dark", shots)
    assert said.out[-3:] == [
        "The capture has no light. Commands estimate it from the photographs; svu light shows the "
        "estimate. If you have an environment map, import again with --environment.",
        "Wrote dark; check it with: svu check dark",
        "Then estimate its light with: svu light dark",
    ]
    said = done("check dark -o out/dark", shots)
    assert any(line.startswith("poses (fits): Cameras and mesh fit") for line in said.out)
    words = "The orientation of the light cannot be determined: no light was given."
    assert f"light (unknown): {words}" in said.out
    assert said.out[-2] == FITS
    said = done("light dark --texels 100 --depths 64 4 --resolution 64 -o dark/light", shots)
    assert any(
        line.startswith("Base colours are determined up to a factor per") for line in said.out
    )
    said = done("entropy dark --resolution 32 -o out/dark_entropy", shots)
    assert any(line.startswith("Using the estimated light in dark/light. ") for line in said.out)


@pytest.mark.slow
def test_textures_are_compared_with_those_of_blender(shots):
    done("recover capture --resolution 64 -o out/textures --no-pictures", shots)
    said = done("compare out/textures scenes/vase -o out/compared", shots)
    assert said.out[-1].startswith("Of the surface that both show, ")
    done("export out/textures -o out/asset", shots)
    assert (shots / "out" / "asset" / "asset.glb").is_file()

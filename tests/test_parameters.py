"""The table of parameters: a new one that only mixes columns takes a few lines."""

from __future__ import annotations

import ast
import copy
import shutil
from dataclasses import FrozenInstanceError
from pathlib import Path

import pytest
from support.helpers import python

import svu_mi
from svu_mi import plugins, scenes
from svu_mi.parameters import MIXED, ByParameter

# ``specular``, 0.5 of which stands for F0 = 0.04; CONTRIBUTING.md lists these files.
EDITS = [
    ("parameters.py", 'end_labels=("0: no metal", "1: metal")),\n',
     'end_labels=("0: no metal", "1: metal")),\n    Parameter("specular"),\n'),
    ("reflection/principled.py", "return e, p, q - d, d - observed",
     "return e, p, q - d, d, d - observed"),
    ("reflection/principled.py", "def mixture(metallic: Any)",
     "def mixture(metallic: Any, specular: Any)"),
    ("reflection/principled.py", "(1 - metallic, metallic, 0, 0), (0, 0, metallic, 1)",
     "(1 - metallic, metallic, 0, 0, 0),"
     " (0, 0, metallic, (1 - metallic) * (2 * specular - 1), 1)"),
    ("reflection/principled.py", "(1, 0, 0, 0), (0, specular, 1, 1)",
     "(1, 0, 0, 0, 0), (0, specular, 1, 0, 1)"),
    ("posterior/grid.py", "    base_color: int = 8\n",
     "    base_color: int = 8\n    specular: int = 8\n"),
]  # fmt: skip


@pytest.mark.slow
def test_one_more_parameter_goes_from_photographs_to_textures(tmp_path):
    package = tmp_path / "svu_mi"
    leave = shutil.ignore_patterns("__pycache__")
    shutil.copytree(Path(svu_mi.__file__).parent, package, ignore=leave)
    for module in (plugins, scenes):
        source = Path(str(module.__file__)).parent
        shutil.copytree(source, package / source.name, ignore=leave)
    for file, old, new in EDITS:
        text = (package / file).read_text()
        assert text.count(old) == 1, (file, old)
        (package / file).write_text(text.replace(old, new))
    script = Path(__file__).parent / "support" / "another_parameter.py"
    result = python(script, tmp_path, PYTHONPATH=str(tmp_path))
    assert result.returncode == 0, result.stderr
    assert str(tmp_path) in result.stdout


def test_a_value_of_every_parameter_is_frozen_and_can_be_shown():
    given = ByParameter(base_color=1, roughness=2, metallic=3)
    with pytest.raises(FrozenInstanceError, match="ByParameter: roughness cannot be set; but"):
        given.roughness = 4
    with pytest.raises(FrozenInstanceError, match="roughness cannot be deleted"):
        del given.roughness
    assert copy.deepcopy(given) == given and given.roughness == 2
    assert repr(given.but(roughness=4)) == "ByParameter(base_color=1, roughness=4, metallic=3)"


# The table, the formulas and the grid; what makes the model's parts visible; rates of a preset;
# other programs' own names for some of the parameters, and what maps other people's models make.
NAMED = {
    "parameters.py", "reflection/principled.py", "posterior/grid.py",
    "posterior/metal_colors.py", "posterior/metal_share.py",
    "evaluation/squared_errors.py", "recovery/recovery_options.py",
    "capture/importers/mesh_materials.py", "output/export/asset_images.py",
    "output/export/asset_scenes.py", "recovery/inpaint/diffusion/model_interface.py",
}  # fmt: skip


def test_no_other_file_names_a_parameter_that_mixes():
    """Names, attributes and keys; text that only mentions one does not count."""
    root = Path(svu_mi.__file__).parent
    files = set()
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            words = {getattr(node, key, None) for key in ("id", "attr", "arg", "value")
                     if isinstance(getattr(node, key, None), str)}  # fmt: skip
            if words & {*MIXED, *(f"{name}_nodes" for name in MIXED)}:
                files.add(path.relative_to(root).as_posix())
    assert {file for file in files if not file.startswith("bench/")} == NAMED

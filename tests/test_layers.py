"""The tree is the pipeline: imports point one way."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

LAYERS = (
    "errors", "names", "memory", "limits", "quiet", "interrupts", "_llvm",
    "interop", "local", "hashing", "files", "npz", "exr", "results", "progress",
    "settings", "parameters", "options", "capture", "formats", "surface",
    "light", "visibility", "frequency", "reflection", "statistics", "observed", "posterior",
    "estimators", "pipeline", "prediction", "illumination", "guidance",
    "regularization", "recovery", "inpaint", "reference", "metrics", "checking", "output", "export",
    "batch", "bench", "cli",
)  # fmt: skip
# Built on the stages; only what stands at the very top may use them.
ABOVE = {"plugins": ("output", "cli"), "scenes": ("output", "bench", "cli")}


def stage_of(path: Path, package: Path) -> str:
    """First folder or file below the package: ``surface`` for geometry/rasterize_uv.py."""
    return path.relative_to(package).parts[0].removesuffix(".py")


def imported_stages(source: str) -> Iterator[str]:
    """Yield the stage of every import of svu_mi, wherever it stands; ``.`` for a relative one.

    ``import svu_mi`` and ``from svu_mi import __version__`` name no stage and yield nothing.
    """
    for node in _nodes(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.level:
            yield "."
        elif isinstance(node, ast.ImportFrom) and node.module == "svu_mi":
            yield from (a.name for a in node.names if not a.name.startswith("__"))
        elif isinstance(node, ast.ImportFrom):
            yield from _stage(node.module or "")
        elif isinstance(node, ast.Import):
            for alias in node.names:
                yield from _stage(alias.name)


def _stage(module: str) -> list[str]:
    head, *rest = module.split(".")
    return rest[:1] if head == "svu_mi" else []


def _nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Walk a tree, except for what only the type checker sees."""
    yield node
    typing_only = isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")
    for child in ast.iter_child_nodes(node):
        if not (typing_only and child in node.body):
            yield from _nodes(child)


def complaint(stage: str, imported: str) -> str | None:
    """Return what is wrong with one import, None if it may be."""
    if imported == ".":
        return "is a relative import; name the stage"
    if imported in ABOVE:
        return None if stage in ABOVE[imported] else f"may be imported by {ABOVE[imported]} only"
    if imported not in LAYERS:
        return "is no stage; import a name from where it is defined"
    return "points upwards" if LAYERS.index(imported) > LAYERS.index(stage) else None


def complaints(package: Path) -> list[str]:
    found = []
    for path in sorted(package.rglob("*.py")):
        stage = stage_of(path, package)
        if stage in ("__init__", "__main__"):
            continue
        if stage not in LAYERS:
            found.append(f"{path.name}: {stage} is not in LAYERS; give it a place")
            continue
        for imported in imported_stages(path.read_text()):
            if problem := complaint(stage, imported):
                found.append(f"{path.relative_to(package)}: import of {imported!r} {problem}")
    return found


def test_imports_point_one_way(root):
    wrong = complaints(root / "svu_mi")
    assert not wrong, "\n".join(wrong)


def test_plugins_and_scenes_use_absolute_imports(root):
    for folder in ABOVE:
        for path in (root / folder).rglob("*.py"):
            assert "." not in imported_stages(path.read_text()), path


def test_the_package_uses_nothing_of_the_tests(root):
    """Studies and oracles are not installed with it."""
    ours = {path.stem for path in (root / "tests").iterdir()}
    for path in (root / "svu_mi").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            assert not ours & {name.split(".")[0] for name in names}, path


def test_the_check_itself_sees_what_it_should(tmp_path):
    """Upward, relative and plugin imports are found, also in functions; typing ones are not."""
    files = {
        "surface/good.py": "from svu_mi.errors import SvuError\nimport svu_mi.capture.mesh\n",
        "surface/upward.py": "def f():\n    from svu_mi import posterior\n",
        "surface/relative.py": "from . import layout\n",
        "surface/plugin.py": "import svu_mi.plugins.registry\n",
        "surface/typing_only.py": "if TYPE_CHECKING:\n    from svu_mi.cli import main\n",
        "surface/otherwise.py": "if TYPE_CHECKING:\n    x = 1\nelse:\n    import svu_mi.cli\n",
        "cli/plugin.py": "import svu_mi.plugins\n",
        "novelty.py": "",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    names = [text.split(":")[0] for text in complaints(tmp_path)]
    wrong = ("otherwise", "plugin", "relative", "upward")
    assert names == ["novelty.py", *(f"surface/{name}.py" for name in wrong)]

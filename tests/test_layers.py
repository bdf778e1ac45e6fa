"""The tree is the pipeline: imports point one way, names tell files and classes apart."""

from __future__ import annotations

import ast
import runpy
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

LAYERS = (
    ("errors",), ("_llvm",), ("core",), ("parameters",), ("presets",), ("capture",), ("geometry",),
    ("light",), ("reflection",), ("statistics", "frequency"), ("posterior",), ("pipeline",),
    ("evaluation", "guidance", "recovery", "calibration"), ("output",), ("bench",), ("cli",),
)  # fmt: skip
PLACE = {room: place for place, rooms in enumerate(LAYERS) for room in rooms}
# Built on the pipeline; only what stands at the very top may use them.
ABOVE = {"plugins": ("output", "cli"), "scenes": ("output", "bench", "cli")}
LOOSE = {"__init__", "__main__", "_llvm", "errors", "parameters", "pipeline", "presets"}
FLOORS = 15
# What may be imported where it is needed: packages of extras, and what draws.
OPTIONAL = {
    "dask", "diffusers", "distributed", "lpips", "matplotlib", "pycolmap", "safetensors", "torch",
    "transformers", "viser", "websockets",
}  # fmt: skip


@cache
def imports(path: Path, package: Path, *, nested: bool = True) -> tuple[str, ...]:
    """Return the modules that a file imports, not for the type checker alone; ``.`` if relative.

    ``from svu_mi.a import b`` is ``svu_mi.a.b`` where that is a module, else ``svu_mi.a``.
    """
    return tuple(_imports(path, package, nested))


def _imports(path: Path, package: Path, nested: bool) -> Iterator[str]:
    for node in _nodes(ast.parse(path.read_text()), nested):
        if isinstance(node, ast.ImportFrom) and node.level:
            yield "."
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("svu_mi"):
            for alias in node.names:
                module = f"{node.module}.{alias.name}"
                exists = _path(module, package) is not None
                if exists or node.module != "svu_mi":
                    yield module if exists else str(node.module)
                elif alias.name in ABOVE:
                    yield module
        elif isinstance(node, ast.ImportFrom):
            yield str(node.module)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def _nodes(node: ast.AST, nested: bool = True) -> Iterator[ast.AST]:
    """Walk all but expressions, code for type checkers, and functions if not ``nested``."""
    yield node
    typing_only = isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")
    for child in ast.iter_child_nodes(node):
        inside = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) and not nested
        skipped = inside or isinstance(child, ast.expr)
        if not skipped and not (typing_only and child in node.body):
            yield from _nodes(child, nested)


def _path(module: str, package: Path) -> Path | None:
    base = package.joinpath(*module.split(".")[1:])
    for path in (base.with_suffix(".py"), base / "__init__.py"):
        if path.is_file():
            return path
    return None


def room_of(module: str) -> str:
    """Room or loose module below the package: ``geometry`` for svu_mi.geometry.texels."""
    return module.split(".")[1] if "." in module else ""


def complaint(room: str, imported: str) -> str | None:
    """Return what is wrong with one import, None if it may be."""
    if imported == ".":
        return "is a relative import; name the room"
    if imported.split(".")[0] != "svu_mi" or imported == "svu_mi":
        return None
    other = room_of(imported)
    if other in ABOVE:
        return None if room in ABOVE[other] else f"may be imported by {ABOVE[other]} only"
    if other not in PLACE:
        return "is no room; import a name from where it is defined"
    below = other == room or PLACE[other] < PLACE[room]
    return None if below else "does not point downwards"


def complaints(package: Path) -> Iterator[str]:
    for path in sorted(package.rglob("*.py")):
        room = path.relative_to(package).parts[0].removesuffix(".py")
        if room in ("__init__", "__main__"):
            continue
        if room not in PLACE:
            yield f"{path.name}: {room} is not in LAYERS; give it a place"
            continue
        for imported in imports(path, package):
            if problem := complaint(room, imported):
                yield f"{path.relative_to(package)}: import of {imported!r} {problem}"


def modules(package: Path) -> dict[str, Path]:
    files = (path.relative_to(package.parent) for path in package.rglob("*.py"))
    return {
        ".".join(file.with_suffix("").parts).removesuffix(".__init__"): package.parent / file
        for file in files
    }


def test_imports_point_one_way(root):
    wrong = list(complaints(root / "svu_mi"))
    assert not wrong, "\n".join(wrong)


def test_loose_modules_and_rooms(root):
    package = root / "svu_mi"
    assert {path.stem for path in package.glob("*.py")} == LOOSE
    rooms = {path.parent.name for path in package.glob("*/__init__.py")}
    assert rooms == set(PLACE) - LOOSE and len(rooms) == 15


def test_no_circle_of_modules(root):
    package = root / "svu_mi"
    own = modules(package)
    graph = {
        name: (set(imports(path, package)) & set(own)) - {name}
        for name, path in own.items() if name != "svu_mi"
    }  # fmt: skip
    TopologicalSorter(graph).prepare()  # raises of a circle


def test_longest_chain_of_rooms(root):
    package = root / "svu_mi"
    below: dict[str, set[str]] = {}
    for name, path in modules(package).items():
        others = {room_of(other) for other in imports(path, package)} & set(PLACE)
        below.setdefault(room_of(name), set()).update(others - {room_of(name)})

    @cache
    def floors(room: str) -> int:
        return 1 + max(map(floors, below[room]), default=0)

    assert max(floors(room) for room in PLACE) <= FLOORS


def test_imports_within_functions_are_optional_or_of_commands(root):
    package = root / "svu_mi"
    for name, path in modules(package).items():
        if room_of(name) in ("cli", "", "__main__", "_llvm"):  # LLVM is chosen before Dr.Jit loads
            continue
        late = set(imports(path, package)) - set(imports(path, package, nested=False))
        assert {module.split(".")[0] for module in late} <= OPTIONAL, (name, late)


def test_names_of_files_and_classes_are_unique(root):
    paths = [path for path in (root / "svu_mi").rglob("*.py") if path.name != "__init__.py"]
    files = Counter(path.name for path in paths if "cli" not in path.parts)
    assert [name for name, count in files.items() if count > 1] == []
    classes = Counter(
        node.name for path in paths for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef)
    )  # fmt: skip
    assert sorted(name for name, count in classes.items() if count > 1) == []


def test_plugins_and_scenes_use_absolute_imports(root):
    for folder in ABOVE:
        for path in (root / folder).rglob("*.py"):
            assert "." not in imports(path, root / "svu_mi"), path


def test_the_picture_of_the_rooms_shows_these_imports(root):
    script = runpy.run_path(str(root / "notebooks" / "draw_rooms.py"))
    now = script["arrows"](script["graph"]())
    assert script["drawn"]() == now, "run python notebooks/draw_rooms.py"


def test_the_package_uses_nothing_of_the_tests(root):
    """Studies and oracles are not installed with it."""
    ours = {path.stem for path in (root / "tests").iterdir()} - sys.stdlib_module_names
    for path in (root / "svu_mi").rglob("*.py"):
        used = {module.split(".")[0] for module in imports(path, root / "svu_mi")}
        assert not ours & used, path


def test_the_check_itself_sees_what_it_should(tmp_path):
    """Upward, relative and plugin imports are found, also in functions; typing ones are not."""
    package = tmp_path / "svu_mi"
    files = {
        "geometry/good.py": "from svu_mi.errors import SvuError\nimport svu_mi.capture.mesh\n",
        "geometry/upward.py": "def f():\n    from svu_mi import posterior\n",
        "geometry/relative.py": "from . import layout\n",
        "geometry/plugin.py": "import svu_mi.plugins.registry\n",
        "geometry/typing_only.py": "if TYPE_CHECKING:\n    from svu_mi.cli import main\n",
        "geometry/otherwise.py": "if TYPE_CHECKING:\n    x = 1\nelse:\n    import svu_mi.cli\n",
        "posterior/__init__.py": "",
        "cli/plugin.py": "import svu_mi.plugins\n",
        "novelty.py": "",
    }
    for name, text in files.items():
        (package / name).parent.mkdir(exist_ok=True, parents=True)
        (package / name).write_text(text)
    names = [text.split(":")[0] for text in complaints(package)]
    wrong = ("otherwise", "plugin", "relative", "upward")
    assert names == [*(f"geometry/{name}.py" for name in wrong), "novelty.py"]

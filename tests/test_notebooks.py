"""Notebooks run from top to bottom, and are committed with their outputs."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import nbformat
import pytest
from ipykernel.kernelspec import write_kernel_spec
from jupyter_client.kernelspec import KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient

FOLDER = Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"), key=lambda path: path.name)
MAX_BYTES = 1_500_000  # a clone pays for every picture of every version
SECONDS = 300  # for one cell; the whole takes some 15 s, most of it compiling kernels
SHORT = f"""
import sys
sys.path.append({str(FOLDER.parent / "tests")!r})
from support import quick_kernels, repeated_work
quick_kernels.use()
repeated_work.remember()
from dataclasses import replace
from svu_mi.recovery.recovery_options import SH_PRESETS
for name, options in SH_PRESETS.items():
    few = {{part: replace(getattr(options, part), steps=10) for part in ("smoothing", "descent")}}
    SH_PRESETS[name] = replace(options, **few)
"""
# What absolute paths of a machine begin with, on Linux, macOS and Windows.
MACHINE_PATH = re.compile(
    r"(?<![\w.~/:])/(home|root|tmp|usr|opt|var|mnt|work|Users)/|\b[A-Z]:\\{1,2}\w"
)

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def outputs_of(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", ())]


def text_of(output) -> str:
    """All that an output says in words; pictures are left out."""
    data = output.get("data", {})
    words = [str(value) for kind, value in data.items() if not kind.startswith("image/")]
    return "\n".join([output.get("text", ""), *words])


def test_there_is_a_notebook():
    names = ["conventions", "entropy", "guidance", "import", "light", "recovery", "uncertainty"]
    assert [path.stem for path in NOTEBOOKS] == names


@each_notebook
def test_is_committed_executed(path):
    assert path.stat().st_size < MAX_BYTES
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = outputs_of(notebook)
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.output_type == "error"]
    # No warnings: a reader would think that something is wrong.
    assert not [output.text for output in outputs if output.get("name") == "stderr"]


@each_notebook
def test_names_no_path_of_a_machine(path):
    notebook = nbformat.read(path, as_version=4)
    texts = [cell.source for cell in notebook.cells] + [text_of(o) for o in outputs_of(notebook)]
    assert not [line for text in texts for line in text.splitlines() if MACHINE_PATH.search(line)]


@pytest.mark.slow
@each_notebook
def test_runs(path, tmp_path, monkeypatch):
    monkeypatch.setenv("SVU_NOTEBOOK_QUICK", "1")
    # A kernel of this very Python, whatever "python3" means to the Jupyter of the machine.
    folder = tmp_path / "kernels" / "python3"
    write_kernel_spec(str(folder))
    assert sys.executable in (folder / "kernel.json").read_text()
    specs = KernelSpecManager(kernel_dirs=[str(folder.parent)], ensure_native_kernel=False)
    manager = AsyncKernelManager(kernel_name="python3", kernel_spec_manager=specs)
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    notebook.cells.insert(0, nbformat.v4.new_code_cell(SHORT))
    # Elsewhere than in the checkout: a notebook reads nothing from where it lies.
    client = NotebookClient(
        notebook, km=manager, timeout=SECONDS, resources={"metadata": {"path": str(tmp_path)}}
    )
    # Raises CellExecutionError with the traceback; a kernel that is left running keeps 500 MB.
    client.execute(cleanup_kc=True)
    outputs = outputs_of(notebook)
    assert not [output for output in outputs if output.output_type == "error"]
    pictures = ["image/png" in output.get("data", {}) for output in outputs]
    assert any(pictures)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["kernels"]  # and leaves nothing there

"""Execute notebooks in place, and store their pictures small: python notebooks/execute.py FILE..."""

from __future__ import annotations

import base64
import io
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

STEP = 4  # quantisation of pixel values in 256 levels: invisible, and a third smaller


def smaller(png: str) -> str:
    """Return a base64-encoded PNG without transparency and with fewer levels per channel."""
    image = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    levels = [min(STEP * round(value / STEP), 255) for value in range(256)]
    buffer = io.BytesIO()
    image.point(levels * 3).save(buffer, "PNG", optimize=True)
    return base64.b64encode(buffer.getvalue()).decode()


def execute(path: Path) -> None:
    """Run a notebook from top to bottom in a fresh kernel, and write it back with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=900, kernel_name="python3", record_timing=False).execute()
    # Remove times and versions, which depend on the machine.
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data:
                data["image/png"] = smaller(data["image/png"])
    nbformat.write(notebook, path)


if __name__ == "__main__":
    for name in sys.argv[1:]:
        execute(Path(name))

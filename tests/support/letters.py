"""Results whose files contain one letter, to detect mixtures of two results."""

from __future__ import annotations

import json
import os
from pathlib import Path

from svu_mi.core.io.files import write_json, write_text
from svu_mi.core.io.output_folder import writing
from svu_mi.core.io.provenance import files_in


def write(
    folder: str | os.PathLike[str], letter: str, files: tuple[str, ...], command: str = "recover"
) -> str:
    """Write a result whose files all hold one letter; return its id."""
    with writing(folder, command, "run.json", capture=letter * 8) as draft:
        for name in files:
            (draft.folder / name).parent.mkdir(exist_ok=True)
            write_text(draft.folder / name, letter)
        write_json(draft.folder / "run.json", {"letter": letter, **draft.entries()})
    return draft.run


def contents(folder: Path) -> dict[str, str]:
    """Return the letter in each file of a folder but the record, and the record's."""
    texts = {name: (folder / name).read_text().strip() for name in files_in(folder)}
    if "run.json" in texts:
        texts["run.json"] = json.loads(texts["run.json"])["letter"]
    return texts

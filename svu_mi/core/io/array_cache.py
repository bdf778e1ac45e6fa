"""Cache of computed arrays: one NPZ file per digest of all inputs.

    cache = ArrayCache(capture_folder / "cache").under(capture_key(capture))
    bits = cache.recall("visibility", [options], trace, pack, restore)

A file is only read if the digest in its name is that of the present inputs, code and libraries. It
is written atomically, and contains a digest of its arrays. The least recently used files are
removed when the folder exceeds its size limit.
"""

import contextlib
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from svu_mi.core.code_digest import digest_of_code
from svu_mi.core.io.files import clear_temporaries, prepare_folder
from svu_mi.core.io.hashes import LETTERS, Key
from svu_mi.core.io.npz import read_arrays, write_arrays
from svu_mi.core.memory import GIGA
from svu_mi.core.progress import Progress
from svu_mi.errors import OutputError, SvuError

NAME = re.compile(rf"[a-z]+-[0-9a-f]{{{LETTERS}}}\.npz")  # other files in the folder are not ours
UNITS = {"GB": GIGA, "MB": 1e6, "kB": 1e3}

Arrays = Mapping[str, np.ndarray]
Result = TypeVar("Result")


@dataclass(frozen=True)
class ArrayCache:
    """Results of earlier computations in a folder.

    Attributes:
        folder: folder of the files; None keeps nothing.
        limit: largest total size of the files in bytes.
        progress: display of what is read and kept.
        base: digest of inputs that all results depend on.
    """

    folder: Path | None = None
    limit: float = GIGA
    progress: Progress = field(default_factory=Progress, repr=False, compare=False)
    base: str = ""

    def under(self, *inputs: Any) -> "ArrayCache":
        """Return the same cache for results that also depend on ``inputs`` (see ``Key``)."""
        return replace(self, base=Key(self.base, *inputs).digest())

    def recall(
        self, name: str, inputs: Sequence[Any], compute: Callable[[], Result],
        pack: Callable[[Result], Arrays], restore: Callable[[Arrays], Result],
    ) -> Result:  # fmt: skip
        """Return ``compute()``, or what an equal computation has kept.

        Args:
            name: kind of the result, in lower-case letters.
            inputs: inputs other than ``base`` that determine the result.
            compute: computation.
            pack: function from a result to arrays.
            restore: inverse of ``pack``, from untrusted arrays; raises ValueError if they are
                invalid, after which the result is computed again.
        """
        if self.folder is None:
            return compute()
        key = Key(digest_of_code(), self.base, name, list(inputs)).digest()
        path = self.folder / f"{name}-{key}.npz"
        with contextlib.suppress(ValueError, SvuError, OSError):
            return self._read(path, name, restore)
        result = compute()
        self._keep(path, name, pack(result))
        return result

    def _read(self, path: Path, name: str, restore: Callable[[Arrays], Result]) -> Result:
        if not path.is_file():
            raise ValueError("nothing is kept")
        with self.progress.stage(f"Reading {name} from {path.parent}"):
            result = restore(read_arrays(path))
        with contextlib.suppress(OSError):
            os.utime(path)  # the least recently used file is removed first
        return result

    def _keep(self, path: Path, name: str, arrays: Arrays) -> None:
        """Write a file, unless it is too large or the folder cannot be written."""
        size = sum(array.nbytes for array in arrays.values())
        if size > self.limit:
            self.progress.say(f"{path.parent}: {_size(size)} of {name} exceed the limit; not kept.")
            return
        try:
            clear_temporaries(prepare_folder(path.parent))
            self._make_room(path.parent, size)
            write_arrays(path, arrays)
        except OutputError as error:
            self.progress.say(f"Nothing is kept for other commands: {error}")
        else:
            self.progress.say(f"Kept {name} in {path.parent} for other commands: {_size(size)}")

    def _make_room(self, folder: Path, size: int) -> None:
        """Remove the least recently used files until ``size`` bytes can be added."""
        files = []
        for path in folder.iterdir():
            with contextlib.suppress(OSError):  # another process has removed it
                if NAME.fullmatch(path.name) and path.is_file() and not path.is_symlink():
                    files.append((path.stat().st_mtime, path.stat().st_size, path))
        total = size + sum(file_size for _, file_size, _ in files)
        for _, file_size, path in sorted(files):
            if total <= self.limit:
                return
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            total -= file_size


def _size(size: float) -> str:
    """Return "1.2 GB", "217 MB" or "8 kB", at least "1 kB"."""
    size = max(size, UNITS["kB"])
    unit = next((name for name, one in UNITS.items() if size >= one), "kB")
    return f"{size / UNITS[unit]:.{int(unit == 'GB')}f} {unit}"

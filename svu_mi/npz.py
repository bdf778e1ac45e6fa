"""Arrays by name in one file that is whole or not there, and is read with care.

    write_arrays("state.npz", {"step": np.array(3), "values/roughness": texture})
    read_arrays("state.npz")["step"]

It is an ``.npz`` archive that NumPy reads, too. Nothing in it is packed, so it never takes more
memory than disk, and it holds a digest of all that was written.
"""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from svu_mi.errors import excerpt
from svu_mi.files import replacing

DIGEST = "digest"
HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def write_arrays(path: str | Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays, numbers or text by name, with a digest; never half of them.

    Raises:
        OutputError: the file cannot be written.
    """
    found = {name: np.asarray(value) for name, value in arrays.items()}
    with replacing(path) as temporary:
        np.savez(temporary, **found, **{DIGEST: np.array(_digest(found))})  # type: ignore[arg-type]


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all that ``write_arrays`` has written.

    Every size is compared with that of the file before anything is read.

    Raises:
        ValueError: it cannot be read, or holds anything else; with the reason, a few words.
    """
    if not path.is_file():  # a pipe, say, would wait for ever
        raise ValueError("it is not a file")
    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            _require_plain(members, path.stat().st_size)
            found = {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}
    except Exception as error:  # a broken archive fails in any way that a zip file can
        raise ValueError(excerpt(error) or type(error).__name__) from error
    digest = found.pop(DIGEST, None)
    if digest is None or digest.shape or str(digest) != _digest(found):
        raise ValueError("its checksum does not match")
    return found


def _require_plain(members: list[zipfile.ZipInfo], size: int) -> None:
    """Refuse what may take more memory than disk: packed members, and those that overlap."""
    if any(member.compress_type != zipfile.ZIP_STORED for member in members):
        raise ValueError("one of its arrays is compressed")
    if sum(member.file_size for member in members) > size:
        raise ValueError("its arrays are larger than the file")
    if len({member.filename for member in members}) < len(members):
        raise ValueError("two of its arrays have the same name")


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Read one array; its header may promise no more than there is."""
    stream = io.BytesIO(archive.read(member))
    version = npy.read_magic(stream)
    if version not in HEADERS:
        raise ValueError("an array has an unknown format version")
    shape, _, dtype = HEADERS[version](stream)
    here = member.file_size - stream.tell()
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != here:
        raise ValueError(f"an array declares {dtype} of shape {shape}, but has {here} bytes")
    stream.seek(0)
    return np.asarray(npy.read_array(stream, allow_pickle=False))


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        total.update(f"{name} {array.dtype.str} {arrays[name].shape} ".encode())
        total.update(array.tobytes())
    return total.hexdigest()

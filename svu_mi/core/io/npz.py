"""Named arrays in an NPZ file: atomic writes, and reads with limited sizes.

    write_arrays("state.npz", {"step": np.array(3), "values/roughness": texture})
    read_arrays("state.npz")["step"]

NumPy can read the file, too. Arrays are not compressed, so that they take no more memory than the
file, and the file contains their digest. From NPY and NPZ files of other programs, arrays of
numbers up to a given size can be read, but no pickled objects.
"""

import contextlib
import hashlib
import io
import math
import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy

from svu_mi.core.io.files import replacing
from svu_mi.errors import excerpt

DIGEST = "digest"
ANY = re.compile("(?s).*")
HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # of NumPy; others ignore limits of size


def write_arrays(path: str | Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays, numbers or text by name, with a digest, atomically."""
    content = {name: np.asarray(value) for name, value in arrays.items()}
    with replacing(path) as temporary:
        np.savez(temporary, **content, **{DIGEST: np.array(_digest(content))})  # type: ignore[arg-type]


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read a file of ``write_arrays``, after a check of its sizes; then check its digest.

    Raises:
        ValueError: the file cannot be read, or is damaged.
    """
    with _opened(path) as file, zipfile.ZipFile(file) as archive:
        # Compressed or overlapping members could take more memory than the file.
        members = _members(archive, ANY, (zipfile.ZIP_STORED,), path.stat().st_size)
        content = {name: _array(archive.read(member)) for name, member in members.items()}
    digest = content.pop(DIGEST, None)
    if digest is None or digest.shape or str(digest) != _digest(content):
        raise ValueError("the checksum does not match")
    return content


def read_foreign_array(path: Path, largest: int) -> np.ndarray:
    """Read real numbers (float64) from an ``.npy`` file of another program; keep NaN and infinity.

    Raises:
        ValueError: the file cannot be read, has more than ``largest`` bytes, or other content.
    """
    with _opened(path, largest) as file:
        return _numbers(file.read())


def read_foreign_arrays(
    path: Path, wanted: re.Pattern[str], largest: int, most: int
) -> dict[str, np.ndarray]:
    """Read up to ``most`` arrays with names like ``wanted`` from an ``.npz`` file.

    ``largest`` also limits the total size of the uncompressed arrays in bytes (see
    ``read_foreign_array``).
    """
    with _opened(path, largest) as file, zipfile.ZipFile(file) as archive:
        members = _members(archive, wanted, PACKINGS, largest)
        if len(members) > most:
            raise ValueError(f"at most {most} arrays are supported, got {len(members)}")
        return {name: _numbers(archive.read(member)) for name, member in members.items()}


@contextlib.contextmanager
def _opened(path: Path, largest: float = math.inf) -> Iterator[BinaryIO]:
    """Open a file; turn all errors of the block into a ValueError with a short reason."""
    if not path.is_file():  # a pipe would block
        raise ValueError("the path is not a file")
    try:
        if path.stat().st_size > largest:
            raise ValueError(f"the file has more than {largest} bytes")
        with path.open("rb") as file:
            yield file
    except Exception as error:  # parsers of damaged files raise any type
        raise ValueError(excerpt(error) or type(error).__name__) from error


def _numbers(data: bytes) -> np.ndarray:
    """Return real numbers as float64, without NumPy's warnings about old headers."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        array = _array(data)
        if array.dtype.kind not in "fiu":
            raise ValueError(f"the array has type {array.dtype}; expected real numbers")
        return array.astype(np.float64)


def _members(
    archive: zipfile.ZipFile, wanted: re.Pattern[str], packings: Sequence[int], largest: int
) -> dict[str, zipfile.ZipInfo]:
    """Return the arrays with matching names; check their compression and total size."""
    named = [(m.filename.removesuffix(".npy"), m) for m in archive.infolist()]
    named = [(name, member) for name, member in named if wanted.fullmatch(name)]
    members = dict(named)
    if any(member.compress_type not in packings for _, member in named):
        raise ValueError("an array has an unknown compression")
    if sum(member.file_size for _, member in named) > largest:
        raise ValueError(f"the arrays have more than {largest} bytes")
    if len(members) < len(named):
        raise ValueError("two arrays have the same name")
    return members


def _array(data: bytes) -> np.ndarray:
    """Decode an array; raise ``ValueError`` if its header does not match the number of bytes."""
    stream = io.BytesIO(data)
    version = npy.read_magic(stream)
    if version not in HEADERS:
        raise ValueError("an array has an unknown format version")
    shape, by_columns, dtype = HEADERS[version](stream)
    here = len(data) - stream.tell()
    if dtype.hasobject:
        raise ValueError("an array declares pickled objects")
    if math.prod(shape) * dtype.itemsize != here:
        raise ValueError(f"an array declares {dtype} of shape {shape}, but has {here} bytes")
    # Not npy.read_array, which copies. The array cannot be written to.
    values = np.frombuffer(data, dtype, offset=stream.tell())
    return values.reshape(shape, order="F" if by_columns else "C")


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        total.update(f"{name} {array.dtype.str} {arrays[name].shape} ".encode())
        total.update(array.reshape(-1).view(np.uint8).data)
    return total.hexdigest()

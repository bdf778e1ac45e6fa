"""Damaged files: random bytes, changed words and numbers, and changed format structures."""

from __future__ import annotations

import json
import random
import re
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

LARGEST = 2**20  # bytes of a file; several changes may multiply it

NUMBERS = [
    0, -1, 1, 2, 3, 255, 65535, 65536, 2**28, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 10**30, 10**400,
    -(2**31), 0.5, -0.0, 1e-300, 1e9, 1e30, 1e308, float("nan"), float("inf"), -float("inf"),
]  # fmt: skip
NAMES = [
    "", ".", "..", "/", "/etc/passwd", "../../secret", "images/../../secret", "C:\\secret", "~",
    "\\\\host\\share", "a\0b", "\ud800", "x" * 300, "x/" * 2000, "link", "loop", "pipe", "folder",
    "https://example.org/a.png", "data:image/png;base64,AAAA", "data:,", "nul\n\x1b[31m", "*",
]  # fmt: skip
VALUES = [None, True, "", "text", [], {}, [[]], [[[[1]]]], {"a": 1}, [None], *NUMBERS, *NAMES]
TARGETS = [
    "evil", "../evil", "../../evil", "kept/evil", "../kept/evil", "evil.x", "./evil",
    "/evil", "principled", "ply", "obj", "serialized", "scene", "twosided", "merge", "$", "$kind",
    "\\$kind", "scene.xml", "more.xml", "ball.ply", "kept", "more", "ball", "&#46;./evil", "&kind;",
    *NAMES,
]  # fmt: skip
NODES = [
    '<bsdf type="{}" id="{}"/>',
    '<shape type="{}"><string name="filename" value="{}"/></shape>',
    '<path value="{}"/><bsdf type="{}"/>',
    '<include filename="{}" name="{}"/>',
    '<ref id="{}"/>',
    '<alias id="{}" as="{}"/>',
    '<default name="kind" value="{}"/><rfilter type="$kind"/>',
    '<spectrum type="{}" filename="{}"/>',
    '<texture type="{}"/>',
    "<?xml {}?>",
    "<!-- {} -->",
    '<!DOCTYPE scene [<!ENTITY kind "{}">]>',
    '<medium type="{}"><phase type="{}"/></medium>',
    '<bsdf type="diffuse" type="{}"/>',
    "<![CDATA[{}]]>",
    '<transform name="{}">',
    "</{}>",
]
PACKED = [*(b"\0" * n for n in (1, 4)), *(b"\xff" * n for n in (1, 2, 4, 8)), *(
    struct.pack(f, v) for f, v in (
        ("<i", 2**31 - 1), ("<I", 2**31), ("<i", 2**28), ("<i", 65536), ("<q", 2**62), ("<H", 1),
        (">i", 2**31 - 1), (">i", 65535), (">H", 65535), ("<f", float("nan")), ("<f", 1e30),
        ("<d", float("inf")), ("<d", float("nan")), ("<d", 1e200), ("<i", -1), ("<f", -0.0),
    )
)]  # fmt: skip


def flipped(data: bytes, draw: random.Random) -> bytes:
    """Change some bits."""
    made = bytearray(data)
    for _ in range(draw.choice((1, 1, 2, 8, 64))):
        made[_position(data, draw)] ^= 1 << draw.randrange(8)
    return bytes(made)


def truncated(data: bytes, draw: random.Random) -> bytes:
    """Drop the end, or all."""
    return data[: draw.choice((0, _position(data, draw), len(data) - 1 - draw.randrange(8)))]


def moved(data: bytes, draw: random.Random) -> bytes:
    """Remove, double, or overwrite a part by another."""
    low = _position(data, draw)
    high = min(len(data), low + draw.choice((1, 2, 4, 8, 32, 256)))
    other = _position(data, draw)
    return draw.choice((
        data[:low] + data[high:],
        data[:high] + data[low:],
        data[:other] + data[low:high] + data[other + high - low :],
        data[:low] + draw.randbytes(high - low) + data[high:],
    ))  # fmt: skip


def packed(data: bytes, draw: random.Random) -> bytes:
    """Overwrite a binary number by one at the end of its range."""
    low, value = _position(data, draw), draw.choice(PACKED)
    if draw.random() < 0.5:
        low -= low % 4
    return (data[:low] + value + data[low + len(value) :])[: len(data)]


def spelled(data: bytes, draw: random.Random) -> bytes:
    """Replace a number that is written in digits."""
    places = list(re.finditer(rb"-?\d+(\.\d+)?(e[-+]?\d+)?", data[:4096])) or [re.match(b"", data)]
    place = draw.choice(places)
    return data[: place.start()] + _text(draw.choice(NUMBERS)) + data[place.end() :]


def worded(data: bytes, draw: random.Random) -> bytes:
    """Replace a word, or all between quotation marks, by a name or a number."""
    pattern = draw.choice((rb'(?<=")[^"\n]*(?=")', rb"[^\s\"<>]+"))
    places = list(re.finditer(pattern, data[:16384])) or [re.match(b"", data)]
    place = draw.choice(places)
    return data[: place.start()] + _text(draw.choice(NAMES + NUMBERS)) + data[place.end() :]


def lined(data: bytes, draw: random.Random) -> bytes:
    """Remove, double, move or multiply lines."""
    lines = data.split(b"\n")
    k, j = draw.randrange(len(lines)), draw.randrange(len(lines))
    match draw.randrange(4):
        case 0:
            del lines[k]
        case 1:
            lines.insert(j, lines[k])
        case 2:
            lines[k], lines[j] = lines[j], lines[k]
        case _:
            lines[k:k] = [lines[k]] * min(5000, LARGEST // (len(lines[k]) + 1))
    return b"\n".join(lines)


def retyped(data: bytes, draw: random.Random) -> bytes:
    """Change JSON by its structure: a value of another type, or a key less, anywhere."""
    root = {"": json.loads(data)}
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        holder, key = draw.choice(list(_places(root)) or [(root, "")])
        match draw.randrange(8):
            case 0 if isinstance(holder, dict) and holder is not root:
                del holder[key]
            case 1:
                holder[key] = [holder[key]] * draw.choice((2, 1000))
            case 2:
                holder[key] = draw.choice(NAMES)
            case 3 | 4:
                holder[key] = draw.choice(NUMBERS)
            case _:
                holder[key] = draw.choice(VALUES)
    if draw.random() < 0.02:
        return b'{"frames": ' + b"[" * 100000
    return json.dumps(root[""]).encode()


def rebuilt_png(data: bytes, draw: random.Random) -> bytes:
    """Change a chunk of a PNG file and give it the right length and sum."""
    chunks, at = [], 8
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    k = draw.randrange(len(chunks))
    kind, body = chunks[k]
    change = draw.choice((packed, packed, flipped, truncated, moved))
    match draw.randrange(6):
        case 0:
            chunks.insert(k, chunks[k])
        case 1:
            del chunks[k]
        case 2:
            chunks.insert(k, (b"zTXt", b"a\0\0" + zlib.compress(b"\0" * 2**20)))
        case 3:
            size = struct.pack(">II", *draw.choices((1, 4, 2**14, 2**20, 2**31 - 1), k=2))
            chunks[0] = (chunks[0][0], size + chunks[0][1][8:])
        case _:
            chunks[k] = (kind, change(body, draw) if body else body)
    return data[:8] + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )


def rebuilt_glb(data: bytes, draw: random.Random) -> bytes:
    """Change the JSON of a GLB file by its structure and give it the right length."""
    (length,) = struct.unpack_from("<I", data, 12)
    body = retyped(data[20 : 20 + length], draw)
    body += b" " * (-len(body) % 4)
    rest = data[20 + length :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(body) + len(rest), len(body), b"JSON")
    return head + body + rest


def resized_exr(data: bytes, draw: random.Random) -> bytes:
    """Change an attribute of an EXR header: a window, the tiles, the compression, ..."""
    names = (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0", b"tiles\0tiledesc\0",
             b"compression\0compression\0", b"channels\0chlist\0", b"chunkCount\0int\0",
             b"type\0string\0", b"lineOrder\0lineOrder\0")  # fmt: skip
    name = draw.choice([name for name in names if name in data])
    at = data.index(name) + len(name)
    if draw.random() < 0.9:
        at += 4  # behind the size of the attribute
    if b"box2i" in name and draw.random() < 0.7:
        corners = draw.choices((-(2**31), -1, 0, 7, 2**14, 2**16, 2**20, 2**31 - 1), k=4)
        return data[:at] + struct.pack("<4i", *corners) + data[at + 16 :]
    at += draw.choice((0, 0, 1, 4, 8, 12))
    value = draw.choice(PACKED + [bytes([draw.randrange(16)])])
    return data[:at] + value + data[at + len(value) :]


def resized_jpeg(data: bytes, draw: random.Random) -> bytes:
    """Change what a JPEG header says: the size, or a table."""
    at = data.index(draw.choice((b"\xff\xc0", b"\xff\xc0", b"\xff\xdb", b"\xff\xc4", b"\xff\xda")))
    at += draw.choice((2, 4, 5, 7, 5, 7, 9, 10, 11))
    value = draw.choice((b"\xff\xff", b"\xff\xff\xff\xff", b"\0\0", b"\x40\0\x40\0", b"\x11"))
    return data[:at] + value + data[at + len(value) :]


def pointed(data: bytes, draw: random.Random) -> bytes:
    """Change what a scene's XML points to: a type, an id, or a file; or add such a node."""
    if draw.random() < 0.3:
        places = [match.end() for match in re.finditer(rb">", data)]
        at = draw.choice(places or [len(data)])
        node = draw.choice(NODES).format(draw.choice(TARGETS), draw.choice(TARGETS))
        return data[:at] + _text(node) + data[at:]
    key = draw.choice((rb"type", rb"id", rb"filename", rb"value", rb"version", rb"name"))
    place = draw.choice(list(re.finditer(key + rb'="([^"]*)"', data)))
    return data[: place.start(1)] + _text(draw.choice(TARGETS)) + data[place.end(1) :]


BINARY = (flipped, truncated, moved, packed)
TEXT = (flipped, truncated, moved, spelled, spelled, worded, worded, lined)
BY_SUFFIX: dict[str, tuple[Callable[[bytes, random.Random], bytes], ...]] = {
    ".json": (retyped, retyped, retyped, retyped, *TEXT), ".gltf": (retyped, retyped, *TEXT),
    ".png": (*BINARY, rebuilt_png, rebuilt_png), ".glb": (*BINARY, rebuilt_glb, rebuilt_glb),
    ".exr": (*BINARY, resized_exr), ".jpg": (*BINARY, resized_jpeg), ".bin": BINARY,
    **dict.fromkeys((".tif", ".webp", ".jxl", ".avif", ".heic", ".dng"), BINARY),
    ".hdr": (*BINARY, spelled), ".pfm": (*BINARY, spelled), ".stl": (*BINARY, spelled),
    ".ply": (*BINARY, spelled, worded, lined),
    ".xml": (pointed, pointed, pointed, pointed, pointed, *TEXT),
}  # fmt: skip


def damaged(files: Mapping[str, bytes], draw: random.Random) -> tuple[str, bytes, str]:
    """Return which file to damage, its new bytes, and what was done."""
    name = draw.choice(sorted(files))
    data, done = files[name], []
    for _ in range(draw.choice((1, 1, 1, 2, 3))):
        mutate = draw.choice(BY_SUFFIX.get(Path(name).suffix, TEXT))
        try:
            data = mutate(data, draw)[:LARGEST]
            done.append(mutate.__name__)
        except (ValueError, LookupError, struct.error, RecursionError):
            continue  # what is damaged already cannot be damaged by its structure
        if not data:
            break
    return name, data, f"{name}: {', '.join(done)}"


def _position(data: bytes, draw: random.Random) -> int:
    """Return a place in a file, every second time in its beginning."""
    return draw.randrange(min(len(data), draw.choice((200, len(data)))))


def _text(value: Any) -> bytes:
    return str(value).encode("utf-8", "surrogatepass")  # half a pair is not UTF-8


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield (holder, key) of everything in a JSON value."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, inner in items:
        yield value, key
        if isinstance(inner, dict | list):
            yield from _places(inner)

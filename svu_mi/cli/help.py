"""``--help``: optional values by type, and texts wrapped to the terminal."""

from __future__ import annotations

import dataclasses
import functools
import operator
import re
import shutil
import sys
import textwrap
import typing
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from types import MappingProxyType
from typing import Any, TextIO, cast

import docstring_parser
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

REGISTRY = ConstructorRegistry()
FRAME = ("│", "╭", "╰", "|", "+")  # how lines of boxes begin, which fit already


@REGISTRY.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Take ``X | None`` for an X that need not be given: ``PATH`` instead of ``{None}|PATH``."""
    kinds = typing.get_args(info.type)
    if type(None) not in kinds or len(kinds) < 2:
        return None
    rest = functools.reduce(operator.or_, [kind for kind in kinds if kind is not type(None)])
    inner = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(rest, info.markers))
    if isinstance(inner, UnsupportedTypeAnnotationError):
        return None

    def words(value: Any) -> list[str]:
        return ["None"] if value is None else inner.str_from_instance(value)

    def fits(value: Any) -> Any:
        return value is None or inner.is_instance(value)

    return dataclasses.replace(inner, str_from_instance=words, is_instance=fits)


@contextmanager
def reflowed_help(commands: Any) -> Iterator[None]:
    """Print the texts of ``--help`` without the line ends that they have in the code."""
    for command in typing.get_args(commands) or (commands,):
        _set_help_texts(typing.get_args(command)[0] if typing.get_args(command) else command)
    width = shutil.get_terminal_size().columns
    with redirect_stdout(cast(TextIO, _WrappingStream(sys.stdout, width))):
        yield


def _set_help_texts(options: Any) -> None:
    """Put the text of each option, in one line, where tyro looks first."""
    if not dataclasses.is_dataclass(options):
        return
    texts: dict[str, str] = {}
    for each in reversed(cast(type, options).__mro__):
        if dataclasses.is_dataclass(each):
            params = docstring_parser.parse_from_object(each).params
            texts |= {param.arg_name: param.description for param in params if param.description}
    for field in dataclasses.fields(options):
        if field.name in texts:
            text = " ".join(texts[field.name].split())
            field.metadata = MappingProxyType({**field.metadata, "help": text})
        _set_help_texts(type(field.default))


class _WrappingStream:
    """Stream that wraps lines longer than the terminal between words."""

    def __init__(self, stream: TextIO, width: int) -> None:
        self._stream, self._width = stream, width

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        lines = []
        for line in text.split("\n"):
            if line.startswith(FRAME) or len(line) <= self._width:
                lines.append(line)
            else:  # the list of all commands has no space
                parts = re.sub(r",(?=\w)", ", ", line)
                lines += textwrap.wrap(parts, self._width, break_on_hyphens=False)
        return self._stream.write("\n".join(lines))

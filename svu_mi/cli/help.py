"""``--help``: commands in groups, options in order of use, texts wrapped to the terminal."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import operator
import shutil
import textwrap
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import docstring_parser
import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

REGISTRY = ConstructorRegistry()
INDENT, WIDEST = 24, 100  # columns
NO_CONFIG: Any = tyro.conf.arg()
FIRST, OTHERS = "options", "advanced"
# Titles of further groups in order, with names of options or of fields that contain options.
GROUPS = {
    "scene and photographs": "define shape images masks missing every exposures gains response "
    "shrink render spp unwrap",
    "source": "reading undistort",
    "mesh": "mesh mesh-up world-up mesh-scale geometry-only",
    "light": "light environment environment-axes environment-scale environment-view light-scale",
    "estimate": "method preset known skip",
    "choice of views": "lowest up distance reachable unreachable guidance",
    "diffusion model": "diffusion",
    OTHERS: "",
    "output": "output overwrite pictures title",
    "run": "memory threads variant trust verbose",
}
TITLES = {name: title for title, names in GROUPS.items() for name in names.split()}


@REGISTRY.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Take ``X | None`` for an X that may be omitted: ``PATH`` instead of ``{None}|PATH``."""
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


def overview(groups: Mapping[str, Mapping[str, Any]], description: str) -> str:
    """Return the text of ``svu --help``: one line per command."""
    paragraphs = ["usage: svu COMMAND [OPTIONS]", _wrap(description)]
    for title, commands in groups.items():
        lines = [_entry(f"  {name}", _summary(commands[name])[0], 11) for name in commands]
        paragraphs.append("\n".join([f"{title}:", *lines]))
    end = "svu COMMAND --help lists the options of a command; svu --version prints the version."
    return "\n\n".join([*paragraphs, _wrap(end)])


def command_help(name: str, command: Any) -> str:
    """Return the text of ``svu NAME --help``: the first options, then the others in groups."""
    first, positional = command.first.split(), []
    groups: dict[str, dict[str, str]] = {title: {} for title in (FIRST, *GROUPS)}
    with REGISTRY:
        for option in _options(command):
            titles = (TITLES[word] for word in (option.name, *option.path) if word in TITLES)
            title = FIRST if option.name in first else next(titles, OTHERS)
            groups[title][option.name] = _entry(f"  {option.flags}", option.text, INDENT)
            positional += [] if option.flags.startswith("-") else [option.flags]
    groups[FIRST] = {option: groups[FIRST][option] for option in first}
    usage = " ".join(["usage: svu", name, *positional, "[OPTIONS]"])
    listed = ["\n".join([f"{title}:", *lines.values()]) for title, lines in groups.items() if lines]
    return "\n\n".join([_wrap(usage), *map(_wrap, _summary(command)), *listed])


class _Option(NamedTuple):
    """Option of a command; ``path`` contains the names of its groups, innermost first."""

    name: str
    path: tuple[str, ...]
    flags: str
    text: str


def _options(source: Callable[..., Any], path: tuple[str, ...] = ()) -> Iterator[_Option]:
    """Yield the options of a class of options, or of a constructor."""
    hints, texts = typing.get_type_hints(source, include_extras=True), _texts(source)
    for field, parameter in inspect.signature(source).parameters.items():
        extras: tuple[Any, ...] = getattr(hints[field], "__metadata__", ())
        kind = typing.get_args(hints[field])[0] if extras else hints[field]
        config = next((each for each in extras if hasattr(each, "metavar")), NO_CONFIG)
        constructor = config.constructor_factory and config.constructor_factory()
        if constructor or dataclasses.is_dataclass(kind):
            yield from _options(constructor or kind, (field, *path))
            continue
        name, default = config.name or field.replace("_", "-"), parameter.default
        text = " ".join((config.help or texts[field]).split()).removesuffix(".")
        text += _default(default)
        flags = ", ".join([*(config.aliases or ()), f"--{name}"])
        if tyro.conf.Positional in extras:
            flags = config.metavar
        elif kind is bool:
            flags += f", --no-{name}" if default else ""
        else:
            flags += f" {config.metavar or _metavar(kind)}"
        yield _Option(name, path, flags, text)


def _texts(source: Any) -> dict[str, str]:
    """Return the docstrings of fields, also of base classes, or of arguments."""
    texts: dict[str, str] = {}
    for each in reversed(source.__mro__ if inspect.isclass(source) else [source]):
        if each is source or dataclasses.is_dataclass(each):
            params = docstring_parser.parse_from_object(each).params
            texts |= {param.arg_name: param.description for param in params if param.description}
    return texts


def _metavar(kind: Any) -> str:
    """Return what tyro calls values of a type, such as INT."""
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kind, set()))
    return getattr(spec, "metavar", "VALUE")


def _default(value: Any) -> str:
    """Return the end of a text; a text contains its default itself where this one is empty."""
    if value is inspect.Parameter.empty:
        return " (required)."
    if value is False or value in (None, "", ()):
        return "."
    return f" (default: {'on' if value is True else _words(value)})."


def _words(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(map(_words, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _summary(command: Any) -> list[str]:
    """Return the paragraphs of a command's docstring."""
    return (inspect.getdoc(command) or "").split("\n\n")


def _entry(head: str, text: str, indent: int) -> str:
    """Return a name and its text in two columns, or below each other if the name is long."""
    if len(head) + 2 <= indent:
        return _wrap(text, head.ljust(indent), indent)
    if len(head) > _width():
        head = head.replace(",", ", ")
    return f"{_wrap(head.strip(), '  ', 6)}\n{_wrap(text, ' ' * indent, indent)}"


def _wrap(text: str, start: str = "", indent: int = 0) -> str:
    return textwrap.fill(
        " ".join(text.split()), _width(), initial_indent=start, subsequent_indent=" " * indent,
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


def _width() -> int:
    return min(shutil.get_terminal_size().columns, WIDEST)

"""``--help``: commands in groups, options in order of use, texts wrapped to the terminal."""

import dataclasses
import functools
import inspect
import operator
import re
import shutil
import textwrap
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import docstring_parser
import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

REGISTRY = ConstructorRegistry()
OPTION = r"--[a-z][a-z-]*"
INDENT, NARROW, WIDEST = 24, 56, 100  # columns
NO_CONFIG: Any = tyro.conf.arg()
FIRST, OTHERS = "options", "advanced"
# Titles of further groups in order, with names of options or of fields that contain options.
GROUPS = {
    "scene and photographs": "define shape images masks missing every exposures gains response "
    "shrink render spp unwrap",
    "source": "reading undistort",
    "mesh": "mesh mesh-up world-up mesh-scale geometry-only",
    "table": "table table-albedo",
    "flash": "flash flash-intensity",
    "light": "light environment environment-axes environment-scale environment-view light-scale",
    "estimate": "method preset known bounces skip",
    "choice of views": "lowest up distance reachable unreachable guidance",
    "diffusion model": "diffusion",
    OTHERS: "",
    "output": "output overwrite pictures title",
    "run": "memory cache cache-size threads variant trust verbose",
}
TITLES = {name: title for title, names in GROUPS.items() for name in names.split()}


@REGISTRY.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Parse an option of type ``X | None`` as ``X``: show ``PATH``, not ``{None}|PATH``."""
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
    paragraphs.append(_wrap("Options of a command: svu COMMAND --help; version: svu --version"))
    return "\n\n".join(paragraphs)


def command_help(name: str, command: Any) -> str:
    """Return the text of ``svu NAME --help``: the first options, then the others in groups."""
    usage, first = ["usage: svu", name], command.first.split()
    groups: dict[str, dict[str, str]] = {FIRST: dict.fromkeys(first, "")}
    groups |= {title: {} for title in GROUPS}
    with REGISTRY:
        for option, title, flags, text in _options(command):
            group = groups[FIRST if option in first else TITLES.get(option, title)]
            group[option] = _entry(f"  {flags}", text, INDENT)
            usage += [] if flags.startswith("-") else [flags]
    listed = ["\n".join([f"{title}:", *group.values()]) for title, group in groups.items() if group]
    usage = [_wrap(" ".join([*usage, "[OPTIONS]"])), *map(_wrap, _summary(command))]
    return "\n\n".join(usage + listed)


def flags_of(command: Any) -> list[str]:
    """Return all options of a command with their values: ``--mesh PATH``."""
    with REGISTRY:
        return [each[2] for each in _options(command)]


def _options(source: Callable[..., Any], title: str = OTHERS) -> Iterator[tuple[str, ...]]:
    """Yield name, group title, flags and help text of each option of a class or constructor."""
    hints, texts = typing.get_type_hints(source, include_extras=True), _texts(source)
    for field, parameter in inspect.signature(source).parameters.items():
        extras: tuple[Any, ...] = getattr(hints[field], "__metadata__", ())
        kind = typing.get_args(hints[field])[0] if extras else hints[field]
        config = next((each for each in extras if hasattr(each, "metavar")), NO_CONFIG)
        constructor = config.constructor_factory and config.constructor_factory()
        if constructor or dataclasses.is_dataclass(kind):
            yield from _options(constructor or kind, TITLES.get(field, title))
            continue
        name, default = config.name or field.replace("_", "-"), parameter.default
        flags = ", ".join([*(config.aliases or ()), f"--{name}"])
        if tyro.conf.Positional in extras:
            flags = config.metavar
        elif kind is bool:
            flags += f", --no-{name}" if default else ""
        else:
            spec: Any = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kind, set()))
            flags += f" {config.metavar or spec.metavar}"
        text = (config.help or texts[field]).replace("``", "").rstrip(".")
        yield name, title, flags, f"{text}{_default(default)}."


def _texts(source: Any) -> dict[str, str]:
    """Return docstrings by name: of a function's arguments, or of own and inherited fields."""
    texts: dict[str, str] = {}
    for each in reversed(source.__mro__ if inspect.isclass(source) else [source]):
        if each is source or dataclasses.is_dataclass(each):
            params = docstring_parser.parse_from_object(each).params
            texts |= {param.arg_name: param.description for param in params if param.description}
    return texts


def _default(value: Any) -> str:
    """Return " (default: ...)" or " (required)"; empty for False, None and empty values."""
    if value is inspect.Parameter.empty:
        return " (required)"
    if value is False or value in (None, "", ()):
        return ""
    words = re.sub(r"[(),']+", "", str(value))  # a tuple as it is given on the command line
    return f" (default: {'on' if value is True else words})"


def _summary(command: Any) -> list[str]:
    """Return the paragraphs of a command's docstring."""
    return (inspect.getdoc(command) or "").split("\n\n")


def _entry(head: str, text: str, indent: int) -> str:
    """Return two columns, ``head`` and ``text``, or two rows if ``head`` is long."""
    if len(head) + 2 <= indent:
        return _wrap(text, head.ljust(indent), indent)
    if len(head) > NARROW:
        head = head.replace(",", ", ")
    return f"{_wrap(head.strip(), '  ', 6)}\n{_wrap(text, ' ' * indent, indent)}"


def _wrap(text: str, start: str = "", indent: int = 0) -> str:
    width = min(shutil.get_terminal_size().columns, WIDEST)
    return textwrap.fill(
        " ".join(text.split()), width, initial_indent=start, subsequent_indent=" " * indent,
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip

"""Type checks of arguments and options by their annotations."""

import inspect
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import wraps
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np

from svu_mi.errors import OptionError, excerpt

WORDS: dict[Any, tuple[Any, str]] = {  # accepted types, and how messages name them
    int: (Integral, "a whole number"), float: (Real, "a number"),
    bool: ((bool, np.bool_), "True or False"), Mapping: (Mapping, "a dict"),
    Callable: (Callable, "a function"), Sequence: (Collection, "a list"),
    Iterable: (Iterable, "a list"), tuple: (Collection, "a tuple"),
    np.ndarray: ((np.ndarray, list, tuple), "an array"),
}  # fmt: skip
LISTS = (Sequence, Iterable, tuple)  # which text is not
SOURCES = {  # calls that return arguments of a class
    "Capture": "svu.load_capture(path)", "Texels": "svu.texels(capture, resolution)",
    "Estimate": "svu.estimate(capture, texels)", "Recovery": "svu.recover(capture, texels)",
    "Source": "svu.read_source(path)", "LightEstimate": "svu.load_light(path)",
    "ImportOptions": "svu.ImportOptions(mesh=path)", "Light": "svu.Light(path=path)",
    "Candidates": "svu.Candidates.around(capture)",
}  # fmt: skip
LONGEST = 60  # characters of a value in a message


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a public function or method that refuses arguments of other types than annotated.

    Lists become arrays if arrays are annotated. The function raises OptionError, and belongs to the
    package ``svu_mi``, where ``pickle`` finds it.
    """
    signature, label = inspect.signature(function), f"{function.__qualname__}()"

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError as error:
            known = ", ".join(signature.parameters)
            raise OptionError(f"{label}: {error}; it has {known}.") from None
        for name, value in bound.arguments.items():
            parameter = signature.parameters[name]
            if parameter.kind is parameter.VAR_KEYWORD or parameter.annotation is parameter.empty:
                continue
            if problem := mismatch(value, parameter.annotation):
                raise OptionError(f"{label}: {name}{problem}")
            if isinstance(value, list | tuple) and np.ndarray in _choices(parameter.annotation):
                bound.arguments[name] = np.asarray(value)
        return function(*bound.args, **bound.kwargs)

    call.__module__ = "svu_mi"
    return call


def mismatch(value: Any, annotation: Any) -> str | None:
    """Return the rest of a sentence, after a name, if a value has another type than annotated."""
    choices = _choices(annotation)
    problems = [_item_mismatch(value, each) for each in choices if _fits(value, each)]
    if problems:
        return None if None in problems else problems[0]
    kinds = [get_origin(each) or each for each in choices if each is not NoneType]
    names = [kind.__name__ for kind in kinds if isinstance(kind, type)]
    words = list(dict.fromkeys(map(_words, kinds)))
    expected = " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
    if bool in kinds and NoneType in choices:
        expected = "True, False or None"
    if not names:
        expected = f"one of {', '.join(kinds)}"
    remedy = next((f"; use {SOURCES[name]}" for name in names if name in SOURCES), "")
    if "Path" in names and isinstance(value, Mapping):
        remedy = "; write a scene to a file with mi.parser.write_file"
    return f" must be {expected}, got {excerpt(repr(value), LONGEST)}{remedy}."


def _item_mismatch(value: Any, annotation: Any) -> str | None:
    """Return the ``mismatch`` of the first item of a dict, list or tuple that has one."""
    kinds = get_args(annotation)
    if not kinds or not isinstance(value, Collection):
        return None
    if isinstance(value, Mapping):
        items = [(key, item, kinds[1]) for key, item in value.items()]
    elif get_origin(annotation) is not tuple or Ellipsis in kinds:
        items = [(place, item, kinds[0]) for place, item in enumerate(value)]
    elif len(value) != len(kinds):
        return f" must have {len(kinds)} values, got {excerpt(repr(value), LONGEST)}."
    else:
        items = [(place, *pair) for place, pair in enumerate(zip(value, kinds, strict=True))]
    problems = ((place, mismatch(item, kind)) for place, item, kind in items)
    return next((f"[{place!r}]{problem}" for place, problem in problems if problem), None)


def _choices(annotation: Any) -> tuple[Any, ...]:
    """Return the types of a union, and the words of a Literal."""
    origin = get_origin(annotation)
    if origin in (Union, UnionType):
        return tuple(choice for each in get_args(annotation) for choice in _choices(each))
    return get_args(annotation) if origin is Literal else (annotation,)


def _fits(value: Any, choice: Any) -> bool:
    """Return whether a value has a type, or is a word; True if that cannot be tested."""
    if isinstance(choice, str):
        return isinstance(value, str) and value == choice
    choice = get_origin(choice) or choice
    if choice is Any or not isinstance(choice, type) or getattr(choice, "_is_protocol", False):
        return True
    if isinstance(value, bool) and choice in (int, float):
        return False
    kinds = WORDS[choice][0] if choice in WORDS else choice
    return isinstance(value, kinds) and not (choice in LISTS and isinstance(value, str))


def _words(choice: Any) -> str:
    """Return the name of a type or word, with an article."""
    if isinstance(choice, str):
        return repr(choice)
    name = choice.__name__
    return WORDS[choice][1] if choice in WORDS else f"a{'n' * (name[0] in 'AEIO')} {name}"

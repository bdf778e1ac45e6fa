"""The parameters that are estimated: those of Mitsuba's ``principled`` BSDF, in one table.

A parameter is asked for in one of three ways. Radiance is linear in ``base_color``, which is
integrated in closed form; light is filtered for every level of ``roughness``, which statistics are
gathered at; all others only say how much of each part of the reflected light there is
(``reflection/principled.py``), and posteriors go over nodes of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import FrozenInstanceError, dataclass
from typing import Any, NoReturn, Self


@dataclass(frozen=True)
class Parameter:
    """A parameter of the material.

    Attributes:
        name: what ``principled`` calls it.
        channels: values per texel.
        low: its smallest value.
        high: its largest value.
        default: what is assumed while nothing is known.
        has_atoms: whether most surfaces have its smallest or its largest value, exactly: the
            preset says how many.
        end_labels: words for both.
    """

    name: str
    channels: int = 1
    low: float = 0.0
    high: float = 1.0
    default: float = 0.5
    has_atoms: bool = False
    end_labels: tuple[str, str] = ("0", "1")

    def holds(self, value: float) -> bool:
        """Return whether a value is in range; NaN is not."""
        return self.low <= value <= self.high


PARAMETERS = {p.name: p for p in (
    Parameter("base_color", channels=3, end_labels=("0: black", "1: white")),
    Parameter("roughness", end_labels=("0: mirror", "1: matt")),
    Parameter("metallic", has_atoms=True, end_labels=("0: no metal", "1: metal")),
)}  # fmt: skip
NAMES = tuple(PARAMETERS)
CHANNELS = {p.name: p.channels for p in PARAMETERS.values()}
MIXED = tuple(name for name in NAMES if name not in ("base_color", "roughness"))
AXES = ("roughness", *MIXED, "base_color")  # of grids, slowest first


class ByParameter(Mapping[str, Any]):
    """A value of every parameter: by name, as in a dictionary, or as an attribute.

    It is frozen; ``but`` returns another.

    Raises:
        TypeError: one is missing, or there is another.
        FrozenInstanceError: an attribute is set or deleted.
    """

    _values: dict[str, Any]

    def __init__(self, **values: Any) -> None:
        if values.keys() != PARAMETERS.keys():
            raise TypeError(
                f"{type(self).__name__}() takes {', '.join(NAMES)}, got {', '.join(values)}."
            )
        object.__setattr__(self, "_values", {name: values[name] for name in NAMES})

    def but(self, **values: Any) -> Self:
        """Return the same with other values of some parameters."""
        return type(self)(**(self._values | values))

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __getattr__(self, name: str) -> Any:
        if name in PARAMETERS:
            return self._values[name]
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}.")

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise FrozenInstanceError(
            f"{type(self).__name__}: {name} cannot be set; but() returns one with other values."
        )

    def __delattr__(self, name: str) -> NoReturn:
        raise FrozenInstanceError(f"{type(self).__name__}: {name} cannot be deleted.")

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={value!r}" for name, value in self.items())
        return f"{type(self).__name__}({values})"

"""Table of the estimated parameters of Mitsuba's ``principled`` BSDF.

Posteriors treat three kinds of parameters differently. Radiance is linear in ``base_color``, which
is integrated in closed form. ``roughness`` changes the lobes, so statistics are gathered at fixed
roughness levels. All others (``MIXED``) only re-weight reflectance components
(``reflection/principled.py``); they are integrated by quadrature.
"""

from collections.abc import Iterator, Mapping
from dataclasses import FrozenInstanceError, dataclass
from typing import Any, NoReturn, Self


@dataclass(frozen=True)
class Parameter:
    """Material parameter.

    Attributes:
        name: name in Mitsuba's ``principled`` BSDF.
        channels: number of values per texel.
        low: smallest value.
        high: largest value.
        default: value if not specified, such as in initial textures.
        has_atoms: True if the prior has point masses at ``low`` and ``high``, with the total
            probability ``AngularPreset.metals``.
        end_labels: labels of ``low`` and ``high`` in plots.
    """

    name: str
    channels: int = 1
    low: float = 0.0
    high: float = 1.0
    default: float = 0.5
    has_atoms: bool = False
    end_labels: tuple[str, str] = ("0", "1")

    def holds(self, value: float) -> bool:
        """Return whether a value is in [low, high]; False for NaN."""
        return self.low <= value <= self.high


PARAMETERS = {p.name: p for p in (
    Parameter("base_color", channels=3, end_labels=("0: black", "1: white")),
    Parameter("roughness", end_labels=("0: mirror", "1: matt")),
    Parameter("metallic", has_atoms=True, end_labels=("0: no metal", "1: metal")),
)}  # fmt: skip
NAMES = tuple(PARAMETERS)
CHANNELS = {p.name: p.channels for p in PARAMETERS.values()}
MIXED = tuple(name for name in NAMES if name not in ("base_color", "roughness"))
AXES = ("roughness", *MIXED, "base_color")  # axes of grids, the slowest first


class ByParameter(Mapping[str, Any]):
    """Immutable mapping from parameter names to values, with attribute access.

    Raises:
        TypeError: a parameter is missing or unknown.
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
        """Return a copy with some values replaced."""
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
            f"{type(self).__name__}: {name} cannot be set; but() returns a changed copy."
        )

    def __delattr__(self, name: str) -> NoReturn:
        raise FrozenInstanceError(f"{type(self).__name__}: {name} cannot be deleted.")

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={value!r}" for name, value in self.items())
        return f"{type(self).__name__}({values})"

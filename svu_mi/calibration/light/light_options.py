"""Options of the estimate of the light."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral
from typing import Any, Literal

from svu_mi.core.validation import require, require_ranges, require_types
from svu_mi.errors import OptionError

Background = Literal["none", "distant"]


@dataclass(frozen=True, kw_only=True)
class LightOptions:
    """Options of ``estimate_light``."""

    texels: int = 900
    """Texels that are looked at, at most: more take longer and change little."""

    moves: bool | None = None
    """Whether the light turns with the cameras, as on a turntable, or stands still; None tries
    both and takes what explains the photographs."""

    background: Background = "none"
    """``distant``: pixels beyond the object show the light itself (not in a light tent, nor
    anything near). ``none``: only the object is looked at."""

    gains: bool = False
    """Whether photographs have gains that are not known: exposure and white balance by themselves.
    They are estimated together with the light."""

    depths: tuple[tuple[int, int], ...] = ((256, 8), (1024, 4))
    """Numbers of cells of the sphere, ascending, and rounds at each."""

    draws: int = 8
    """Other lights that explain the photographs as well, by which textures are less certain."""

    seed: int = 0
    """Of the draws."""

    def __post_init__(self) -> None:
        require_types(self)
        require_ranges(self, texels=(16, 10_000), draws=(2, 64), seed=(0, 2**31))
        known = self.moves is None or isinstance(self.moves, bool)
        require(self, known, "moves", "True, False or None")
        require(self, isinstance(self.gains, bool), "gains", "True or False")
        if self.gains and self.background == "distant":
            raise OptionError(
                "background 'distant' takes the brightness of photographs as it is, so it cannot "
                "be combined with gains that are not known; omit one of them."
            )
        pairs = "(cells, rounds), ascending, of 64 to 4096 cells and 1 to 100 rounds"
        require(self, _are_depths(self.depths), "depths", pairs)


def _are_depths(depths: Any) -> bool:
    if not isinstance(depths, tuple) or not all(
        isinstance(depth, tuple) and len(depth) == 2
        and all(isinstance(x, Integral) for x in depth)
        for depth in depths
    ):  # fmt: skip
        return False
    cells = [number for number, _ in depths]
    sizes = all(64 <= number <= 4096 and 1 <= rounds <= 100 for number, rounds in depths)
    return bool(depths) and cells == sorted(cells) and sizes

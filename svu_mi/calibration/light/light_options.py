"""Options of the estimate of the light."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from svu_mi.core.validation import require, require_ranges, require_types
from svu_mi.errors import OptionError
from svu_mi.parameters import MIXED

Background = Literal["none", "distant"]


@dataclass(frozen=True, kw_only=True)
class LightOptions:
    """Options of ``estimate_light``.

    Example:
        >>> svu.LightOptions(depths=((64, 2),)).texels
        900
    """

    texels: int = 900
    """Maximum number of sampled texels, in [16, 10000]; more take longer and change little."""

    moves: bool | None = None
    """True if the light moves with the cameras (turntable or flash), False if it is static; None
    tests both and chooses the better fit."""

    background: Background = "none"
    """``distant``: background pixels show the light (wrong in a light tent or near walls);
    ``none``: background pixels are ignored."""

    gains: bool = False
    """True to estimate gains (exposure, white balance) of photographs together with the light."""

    depths: tuple[tuple[int, int], ...] = ((256, 8), (1024, 4))
    """Pairs of a number of cells, in [64, 4096] and ascending, and a number of iterations."""

    known: Mapping[str, float] = field(default_factory=dict, hash=False)
    """Known value of metallic, in [0, 1], such as ``{"metallic": 0.0}``; default: estimated."""

    draws: int = 8
    """Number of posterior samples of the light, in [2, 64], for its effect on textures."""

    seed: int = 0
    """Random seed of the posterior samples, at least 0."""

    def __post_init__(self) -> None:
        require_types(self)
        require_ranges(self, texels=(16, 10_000), draws=(2, 64), seed=(0, 2**31))
        if self.gains and self.background == "distant":
            raise OptionError(
                "background 'distant' needs the recorded exposures and cannot be combined with "
                "estimated gains; omit one of them."
            )
        values = all(name in MIXED and 0 <= x <= 1 for name, x in self.known.items())
        require(self, values, "known", f"a value in [0, 1] of {' or '.join(MIXED)} only")
        cells = [number for number, _ in self.depths]
        valid = all(64 <= number <= 4096 and 1 <= rounds <= 100 for number, rounds in self.depths)
        pairs = "(cells, rounds), ascending, of 64 to 4096 cells and 1 to 100 rounds"
        require(self, bool(cells) and valid and cells == sorted(cells), "depths", pairs)

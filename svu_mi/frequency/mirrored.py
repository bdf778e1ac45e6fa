"""The light that texels mirror into their photographs, to be fitted under any masking."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.errors import OptionError
from svu_mi.frequency.samples import Job, Masking, Photographed
from svu_mi.interop import owned
from svu_mi.options import Fit


@dataclass(frozen=True)
class MirroredLight:
    """The light that texels mirror into their photographs, to be fitted (Eq. 12).

    Attributes:
        observed: the photographs of T texels.
        fit: degree, regulariser and R_00.
        channels: C of the light, 3 or 1.
        chosen: (S,) numbers of the texels to fit: their lanes.
    """

    observed: Photographed
    fit: Fit
    channels: int
    chosen: np.ndarray

    def room(self, rows: int) -> Any:
        """Return zeros for so many numbers per lane, evaluated: (rows S,) Float.

        Raises:
            OptionError: more than one array can hold.
        """
        size = rows * len(self.chosen)
        if size >= 2**32:
            raise OptionError(
                f"The SH model keeps {rows} numbers per texel, which is too much for "
                f"{len(self.chosen)} texels that are seen: {(2**32 - 1) // rows} at most; lower "
                "the resolution, or the degree of the fit."
            )
        values = dr.zeros(mi.Float, size)
        dr.eval(values)
        return values

    @cached_property
    def lane(self) -> Any:
        """(T,) UInt32, which lane a texel has; 0 for others."""
        lane = np.zeros(self.observed.texels.count, np.uint32)
        lane[self.chosen] = np.arange(len(self.chosen))
        return owned(mi.UInt32, lane)

    def solutions(self, masking: Masking, count: int) -> Iterator[tuple[Any, list[list[Any]]]]:
        """Fit masked light.

        Args:
            masking: what the light is multiplied by. It should read opaque numbers, so that one
                kernel serves all.
            count: F, how many factors it returns.

        Yields:
            UInt32 lanes of texels that some view sees, and their (l* + 1)^2 coefficients: lists
            of F C Floats, not evaluated yet.
        """
        for texel, coefficients in self._job.solutions(masking, count):
            yield dr.gather(mi.UInt32, self.lane, texel), coefficients

    @cached_property
    def _job(self) -> Job:
        """Of all steps of a recovery: who is solved by which kernel does not change."""
        counts = np.zeros(self.observed.texels.count, np.uint32)
        counts[self.chosen] = self.observed.found.coverage.numpy()[self.chosen]
        return Job(self.observed, self.fit, counts, 0, self.channels)

"""Recovery methods that benchmarks compare; a new method is added here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from svu_mi.capture.capture import Capture
from svu_mi.core.progress import Progress
from svu_mi.core.validation import require_known
from svu_mi.geometry.texels import Texels
from svu_mi.posterior.estimate import Estimate
from svu_mi.recovery.path.pixel_loss import path_objective
from svu_mi.recovery.recover import recover
from svu_mi.recovery.recovery_options import (
    PATH_PRESETS,
    SH_PRESETS,
    Method,
    PathOptions,
    ShOptions,
)
from svu_mi.recovery.recovery_result import Recovery

DEPTH = 2  # direct light, as in the photographs (bench.cases.DIRECT)


@dataclass(frozen=True)
class RecoveryMethod:
    """A recovery method.

    Attributes:
        label: Name in tables and plots, unique.
        method: Method of ``recover``.
        sh: Preset of the SH model.
        path: Preset of path tracing.
        sharing: Use a prior of materials, learned from all texels.
    """

    label: str
    method: Method
    sh: str = "default"
    path: str = "default"
    sharing: bool = False

    @property
    def traced(self) -> bool:
        """True for methods that trace paths, which is slow."""
        return "path" in self.method

    def options(self, scale: float = 1.0) -> tuple[ShOptions, PathOptions]:
        """Return the options of the presets, for direct light.

        Args:
            scale: Factor of the numbers of path tracing epochs and SH descent steps.
        """
        sh, path = SH_PRESETS[self.sh], PATH_PRESETS[self.path]
        smoothing, descent = (
            replace(one, steps=max(1, round(scale * one.steps)))
            for one in (sh.smoothing, sh.descent)
        )
        return (
            replace(sh, smoothing=smoothing, descent=descent),
            replace(path, epochs=scale * path.epochs, max_depth=DEPTH),
        )

    def source(self, capture: Capture, grid: Texels) -> Capture | Estimate:
        """Return what textures are recovered from."""
        del grid
        return capture

    def recover(self, capture: Capture, grid: Texels, scale: float = 1.0) -> Recovery:
        """Recover the textures of a capture.

        Args:
            capture: Photographs.
            grid: Texels of the mesh.
            scale: Factor of the numbers of epochs and steps.
        """
        sh, path = self.options(scale)
        source = self.source(capture, grid)
        return recover(source, grid, self.method, sharing=self.sharing, sh=sh, path=path)

    def recover_in(
        self, steps: int, capture: Capture, grid: Texels, progress: Progress
    ) -> Recovery:
        """Recover textures in a given number of steps.

        Args:
            steps: Number of steps of the last descent.
            capture: Photographs.
            grid: Texels of the mesh.
            progress: Progress display.
        """
        sh, path = self.options()
        sh = replace(sh, descent=replace(sh.descent, steps=steps, tolerance=0.0))
        if self.traced:
            epoch = path_objective(capture, grid, path).batches.epoch
            path = replace(path, epochs=(steps - 0.5) / epoch)
            path = replace(path, descent=replace(path.descent, tolerance=0.0))
        return recover(
            self.source(capture, grid), grid, self.method, sharing=self.sharing, sh=sh, path=path,
            progress=progress,
        )  # fmt: skip


PATH = RecoveryMethod("path", "path")
PATH_SHARING = RecoveryMethod("path + sharing", "path", sharing=True)
SH = RecoveryMethod("SH (ours)", "sh")
SH_SHARING = RecoveryMethod("SH + sharing", "sh", sharing=True)
SH_PATH = RecoveryMethod("SH + path", "sh+path", path="polish")  # one epoch

# Methods of the paper as printed, for its Tables 1 and 2.
SH_PAPER = RecoveryMethod("SH (paper)", "sh", sh="paper")
SH_PAPER_SHARING = RecoveryMethod("SH (paper) + sharing", "sh", sh="paper", sharing=True)
SPECTRUM = RecoveryMethod("spectrum (paper)", "sh", sh="spectrum")
SH_PAPER_PATH = RecoveryMethod(
    "SH (paper) + path (paper)", "sh+path", sh="paper", path="paper_polish"
)
PATH_PAPER = RecoveryMethod("path (paper)", "path", path="paper")
PATH_PAPER_SHARING = RecoveryMethod("path (paper) + sharing", "path", path="paper", sharing=True)

OURS = (SH, SH_SHARING, SH_PATH, PATH, PATH_SHARING)
PAPER = (SH_PAPER, SH_PAPER_SHARING, SPECTRUM, SH_PAPER_PATH, PATH_PAPER, PATH_PAPER_SHARING)
ROWS = OURS + PAPER
USUAL = (*OURS, SH_PAPER, SH_PAPER_SHARING, SPECTRUM)  # default rows; others take long


def find_method(label: str) -> RecoveryMethod:
    """Return the method with a label.

    Raises:
        OptionError: Unknown label.
    """
    rows = {row.label: row for row in ROWS}
    require_known([label], rows, "row")
    return rows[label]


def choose_methods(labels: Sequence[str]) -> tuple[RecoveryMethod, ...]:
    """Return the methods with given labels, in the order of ``ROWS``; ``USUAL`` without labels.

    Raises:
        OptionError: Unknown label.
    """
    chosen = [find_method(label) for label in labels] or USUAL
    return tuple(row for row in ROWS if row in chosen)

"""``svu guide``: poses of the next photographs."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from rich.console import Console
from tyro.conf import arg

from svu_mi.cli import shared_options as opt
from svu_mi.cli.loading import EstimateCommand, print_prediction
from svu_mi.cli.streams import format_number, print_line
from svu_mi.core.io.files import refusing
from svu_mi.core.io.output_folder import claimed
from svu_mi.core.memory import Need
from svu_mi.core.progress import Progress
from svu_mi.core.validation import indices_of, require_views
from svu_mi.errors import OptionError
from svu_mi.guidance.guidance_options import GuidanceOptions, require_method, require_prediction
from svu_mi.guidance.strategies import TABLE

if TYPE_CHECKING:
    from svu_mi.capture.capture import Capture
    from svu_mi.guidance.candidates import Candidates
    from svu_mi.guidance.guidance_result import Guidance
    from svu_mi.posterior.estimate import Estimate

SCENE = "scene"
From = Annotated[str, arg(metavar="N | FILE | scene")]
Numbers = Annotated[tuple[int, ...], arg(metavar="NUMBER ...")]
Up = Annotated[tuple[float, float, float], arg(metavar="X Y Z")]


@dataclass(frozen=True, kw_only=True)
class Guide(EstimateCommand):
    """Propose the poses of the next photographs.

    Writes guidance.json and guidance.png, the poses as transforms.json and sensors.xml, the
    expected entropy reduction per texel as gain_0.exr, ..., thumbnails/ and run.json.
    """

    first = "scene output candidates add strategy resolution light images lowest reachable"
    output: opt.Output = Path("out/next")
    overwrite: opt.Overwrite = False
    resolution: opt.Resolution = (512,)
    candidates: From = "100"
    """Number of views on a sphere around the object; file of poses (transforms.json, capture.json
    or Mitsuba XML); the word scene: its sensors without a photograph."""
    add: int = 5
    """Number of poses to propose, at least 1; each assumes photographs at the earlier ones."""
    lowest: opt.Number = None
    """Lowest elevation on the sphere in degrees, in [-90, 90); 0: the upper hemisphere, for an
    object on a table (default: -90)."""
    up: Up | None = None
    """Up direction of the sphere and of the direction map (default: from the cameras)."""
    distance: opt.Number = None
    """Radius of the sphere in units of the scene (default: median distance of the photographs)."""
    reachable: Path | None = None
    """File with the numbers of reachable candidates, separated by white space or as a JSON list;
    or a JSON list of one boolean per candidate (default: all)."""
    unreachable: Numbers = ()
    """Numbers of candidates that cannot be reached (default: none)."""
    pictures: opt.Pictures = True
    guidance: GuidanceOptions = GuidanceOptions()

    def run(self, console: Console) -> int:
        """Evaluate the candidates, and write the results."""
        from svu_mi.output.interval_summary import IntervalSummary
        from svu_mi.output.write_guidance import write_guidance

        self.check()
        with claimed(self.output, "guide", overwrite=self.overwrite) as place:
            self.start()
            progress = Progress(console)
            capture, estimate, guidance = self._guide(progress)
            with progress.stage("Writing the results"):
                run = self.run_info(progress)
                write_guidance(
                    capture, estimate, guidance, place, run, up=self.up, pictures=self.pictures
                )  # fmt: skip
        _print(console, capture, estimate, guidance)
        print_line(console, f"Wrote {self.output}")
        print_line(console, IntervalSummary.of(estimate).summary())
        return 0

    def _guide(self, progress: Progress) -> tuple[Capture, Estimate, Guidance]:
        from svu_mi.guidance.candidates import Candidates
        from svu_mi.guidance.next_view import next_best_view

        # Report errors in files before photographs are read.
        fixed = None if self._generated else self._reachable(Candidates.read(self.candidates))
        missing: opt.Missing | None = "leave-out" if self.candidates == SCENE else None
        size, model = opt.parse_resolution(self.resolution), self.estimation.model
        count = _number(self.candidates) or 0
        need = partial(Need, "guide", resolution=size, model=model, candidates=count)
        capture, texels = self.load_with_light(
            progress, need, size, self.estimation.known, missing=missing
        )
        candidates = fixed or self._reachable(self._place_candidates(capture))
        known = self.estimation.estimate(progress, capture, texels, whole=True)
        print_prediction(progress, known)
        guidance = next_best_view(
            known, candidates, self.add, options=self.guidance, progress=progress
        )
        return capture, known, guidance

    @property
    def _generated(self) -> bool:
        """True if candidates are generated from the capture."""
        return self.candidates == SCENE or _number(self.candidates) is not None

    def _place_candidates(self, capture: Capture) -> Candidates:
        from svu_mi.guidance.candidates import Candidates

        count = _number(self.candidates)
        if count is None:
            return Candidates.without_photograph(capture)
        lowest = -1.0 if self.lowest is None else float(np.sin(np.radians(self.lowest)))
        return Candidates.around(capture, count, up=self.up, lowest=lowest, distance=self.distance)

    def _reachable(self, candidates: Candidates) -> Candidates:
        """Return the reachable candidates."""
        return candidates.restricted(self._reachable_flags(candidates.count))

    def _reachable_flags(self, count: int) -> np.ndarray:
        """Return (count,) bool flags of the reachable candidates."""
        flags = np.ones(count, bool)
        if self.reachable is not None:
            numbers = _read_numbers(self.reachable)
            allowed = indices_of(numbers, count, str(self.reachable), "candidate")
            flags = np.isin(np.arange(count), allowed)
        flags[indices_of(self.unreachable, count, "--unreachable", "candidate")] = False
        if not flags.any():
            raise OptionError(
                f"All {count} candidates are unreachable; change --reachable or --unreachable, or "
                "give more --candidates."
            )
        return flags

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""
        super().check()
        opt.require_range("--add", self.add, 1)
        self._check_sphere()
        require_method(self.guidance, self.estimation.method)
        require_prediction(self.estimation.switches())
        if self.reachable is not None:
            _read_numbers(self.reachable)
        if not self._generated and not Path(self.candidates).exists():
            raise OptionError(
                f"--candidates {self.candidates}: must be a number, a file or the word {SCENE}."
            )
        if (count := _number(self.candidates)) is not None:
            self._reachable_flags(count)

    def _check_sphere(self) -> None:
        count = _number(self.candidates)
        opt.require_range("--candidates", count, 1)
        require_views(count or 0, "--candidates")
        for option in ("lowest", "distance"):
            if count is None and getattr(self, option) is not None:
                raise OptionError(
                    f"--{option} has no effect with --candidates {self.candidates}, which gives "
                    "the poses; omit it."
                )
        if self.lowest is not None and not -90 <= self.lowest < 90:
            raise OptionError(
                f"--lowest must be an elevation in [-90, 90) degrees, got {self.lowest:g}."
            )
        if self.distance is not None and not 0 < self.distance < np.inf:
            raise OptionError(f"--distance must be positive, got {self.distance:g}.")
        if self.up is not None and not 0 < np.linalg.norm(self.up) < np.inf:
            raise OptionError(f"--up must be a direction, got {' '.join(map(str, self.up))}.")


def _number(word: str) -> int | None:
    try:
        return int(word)
    except ValueError:
        return None


def _read_numbers(path: Path) -> list[Any]:
    """Read indices separated by white space, or a JSON list of indices or of booleans."""
    with refusing(path, "give numbers, or a JSON list of numbers or of booleans"):
        text = path.read_text(encoding="utf-8")
        values = json.loads(text) if text.lstrip().startswith("[") else list(map(int, text.split()))
        if set(map(type, values)) not in ({int}, {bool}):
            raise ValueError("not a list of candidates")
    return values


def _print(console: Console, capture: Capture, estimate: Estimate, guidance: Guidance) -> None:
    """Print the current entropy, and the proposals as a table."""
    from rich.table import Table

    from svu_mi.output.guidance_page import file_names

    table, names = Table(box=None, pad_edge=False), file_names(capture, guidance)
    for head in ("rank", "candidate", "gain", "+-", "entropy", "sees", "new", "file"):
        table.add_column(head, justify="left" if head == "file" else "right")
    for rank, (proposal, name) in enumerate(zip(guidance.proposals, names, strict=True), 1):
        table.add_row(
            str(rank), str(proposal.candidate),
            format_number(proposal.gain, 4), f"{proposal.error:.1g}" if proposal.error else "-",
            format_number(proposal.entropy, 3),
            f"{proposal.sees:.0%}", f"{proposal.new:.0%}", name,
        )  # fmt: skip
    seen = np.array(estimate.coverage) > 0
    words = (
        f"Current mean entropy: {np.array(estimate.entropy)[seen].mean():.3f} of seen texels, "
        f"{guidance.entropy:.3f} of all texels (unseen: {estimate.posterior.prior_entropy:.3g})."
    )
    if guidance.options.band_limit == "growing":
        words += (
            " Candidates are evaluated in light filtered for one more photograph (Eq. 13), which "
            "is sharper; the entropy after a photograph may therefore exceed the current one."
        )
    if TABLE[guidance.options.strategy].needs_forecast:
        words += (
            " Expected reduction by each photograph (gain), and entropy of all texels after it:"
        )
    console.print(words, highlight=False, soft_wrap=True)
    console.print(table, markup=False, highlight=False)

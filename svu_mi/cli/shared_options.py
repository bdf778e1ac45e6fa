"""Groups of options that several commands share, and parsing of their values."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

from svu_mi.capture.importers.import_options import ENVIRONMENT_AXES, Light
from svu_mi.core.validation import require_spp, require_texels
from svu_mi.errors import OptionError
from svu_mi.parameters import NAMES
from svu_mi.presets import AnyPreset
from svu_mi.presets import preset as find_preset

if TYPE_CHECKING:
    from svu_mi.capture.capture import Capture
    from svu_mi.core.progress import Progress
    from svu_mi.geometry.texels import Texels
    from svu_mi.posterior.estimate import Estimate
    from svu_mi.recovery.svbrdf_textures import Textures

UNITS = {"K": 1e3, "M": 1e6, "G": 1e9, "T": 1e12}  # bytes
CACHE = "cache"  # folder in a capture, which stays there if the capture is replaced
SPECULAR = "specular"  # specular reflectance Ks of power spectra

Output = Annotated[Path, arg(aliases=["-o"], metavar="FOLDER", help="Folder of the results.")]
Overwrite = Annotated[
    bool, arg(help="Replace other files in the output path, which are kept as NAME.before.")
]
Scene = Annotated[Path, Positional, arg(metavar="CAPTURE | SCENE.xml")]
Defines = Annotated[tuple[str, ...], arg(aliases=["-D"], metavar="KEY=VALUE"), UseAppendAction]
Folder = Annotated[Path | None, arg(metavar="FOLDER")]
Memory = Annotated[
    str,
    arg(
        metavar="SIZE",
        help="Memory for photographs, such as 4G or 800M; if they need more, they are kept in a "
        "temporary file in TMPDIR (default: half of the free memory).",
    ),
]
# Numbers without a default; the parser would add "(default: None)" to their help texts.
Number = Annotated[float | None, arg(help_behavior_hint="")]
Count = Annotated[int | None, arg(help_behavior_hint="")]
Missing = Literal["refuse", "leave-out"]
Size = Annotated[tuple[int, ...], arg(metavar="SIZE | WIDTH HEIGHT")]
Resolution = Annotated[
    tuple[int, ...],
    arg(
        metavar="SIZE | WIDTH HEIGHT",
        help="Texels per side, or width and height. Time and memory grow with their number.",
    ),
]
Samples = Annotated[int, arg(help="Samples per pixel with --render; more reduce noise.")]
Pictures = Annotated[bool, arg(help="Draw PNG pictures of the results.")]
Recovered = Annotated[
    Path | None,
    arg(metavar="FOLDER", help="Folder of svu recover, whose textures are shown (default: none)."),
]
GivenLight = Annotated[
    Path | None,
    arg(
        metavar="FOLDER | MAP",
        help="Environment map: folder written by svu light, or lat-long EXR or HDR; see "
        "--environment-axes (default: the map of the scene; estimated if it has none).",
    ),
]
Known = Annotated[
    tuple[str, ...],
    UseAppendAction,
    arg(
        metavar="NAME=VALUE | scene",
        help="Value of a parameter that is not estimated, such as metallic=0; scene: all "
        "parameters that are constant in the scene's material. Repeatable (default: all are "
        "estimated).",
    ),
]


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """The scene and its photographs."""

    scene: Scene
    """Capture folder, or Mitsuba scene with one sensor per photograph."""
    define: Defines = ()
    """Value of a $parameter of the scene, such as light=window; repeatable (default: the values
    in the scene)."""
    shape: str | None = None
    """The object, if the scene contains several shapes: an id, file name, id of a BSDF, number from
    0, or largest principled; commas join several shapes to one object (default: the only one)."""

    def defines(self) -> dict[str, str]:
        """Return the -D words as a dictionary."""
        pairs = [word.partition("=") for word in self.define]
        for word, (key, separator, _) in zip(self.define, pairs, strict=True):
            if not (key and separator):
                raise OptionError(f"-D takes KEY=VALUE, got {word!r}.")
        return {key: value for key, _, value in pairs}


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Convention of an environment map."""

    environment_axes: Literal["mitsuba", "opengl", "threejs", "blender"] = "mitsuba"
    """Axes at the top and centre of the environment map: mitsuba +Y +Z, opengl +Y -Z, threejs
    +Y +X, blender +Z +X."""
    environment_scale: float = 1.0
    """Factor of the map's radiance, if its unit differs from the photographs."""

    def light(self, path: Path | None) -> Light | None:
        """Return a map, or the folder of a light; None without a path."""
        if path is not None:
            axes = ENVIRONMENT_AXES[self.environment_axes]
            return Light(path=path, to_world=axes, scale=self.environment_scale)
        if self != MapOptions():
            raise OptionError("--environment-axes and --environment-scale need a map; give it.")
        return None


@dataclass(frozen=True, kw_only=True)
class PhotographOptions:
    """The photographs."""

    images: Folder = None
    """Folder of the photographs, named view_0000.exr, ... or by sensor ids, or one per sensor in
    natural order (default: the folder of the scene)."""
    missing: Missing = "refuse"
    """Sensors without a photograph: refuse stops, leave-out continues with the other sensors."""
    gains: Literal["auto", "given", "estimate"] = "auto"
    """Exposure and white balance: given, as recorded; estimate, per photograph and channel, for
    automatic cameras, without inconsistent photographs; auto, estimate if neither light nor
    exposures are recorded, and they differ."""
    memory: Memory = ""

    @property
    def bytes(self) -> float | None:
        """Memory for photographs in bytes; None by default."""
        return parse_bytes(self.memory)

    @property
    def estimates_gains(self) -> bool | None:
        """True if exposures are estimated; None if that depends on the capture."""
        return {"auto": None, "given": False, "estimate": True}[self.gains]


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """Options of rendered photographs and of the mesh."""

    render: bool = False
    """Render the photographs from the scene instead of reading them."""
    unwrap: bool = False
    """Compute new UVs even if the mesh has some, for instance if its UVs overlap."""


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """Scene with photographs, read or rendered."""

    source: SceneOptions
    photographs: PhotographOptions = PhotographOptions()
    rendering: RenderOptions = RenderOptions()

    def check(self, spp: int) -> None:
        """Refuse invalid options (OptionError)."""
        require_spp(spp, "--spp")
        scene = self.source.scene
        _ = self.photographs.bytes, self.source.defines()
        if self.rendering.render and self.photographs.images is not None:
            raise OptionError("--render has no effect with --images; omit one of them.")
        if self.rendering.render and scene.suffix.lower() != ".xml":
            raise OptionError(
                f"--render takes a Mitsuba scene (.xml), got {scene}; omit --render to read "
                "the photographs there."
            )


@dataclass(frozen=True, kw_only=True)
class CacheOptions:
    """Results that other commands can read."""

    cache: bool = True
    """Keep statistics in the folder cache of the capture, so that further commands need not
    compute them again."""
    cache_size: Annotated[str, arg(metavar="SIZE")] = "1G"
    """Largest size of the folder cache; its least recently used files are removed."""

    def of(self, capture: Capture, progress: Progress) -> Capture:
        """Return the capture with its cache, if it is a capture folder."""
        from svu_mi.capture.capture_folder import FILE
        from svu_mi.core.io.array_cache import ArrayCache

        if not self.cache or capture.source is None or not (capture.source / FILE).is_file():
            return capture
        kept = ArrayCache(capture.source / CACHE, self.bytes, progress)
        return dataclasses.replace(capture, cache=kept)

    @property
    def bytes(self) -> float:
        """Largest size in bytes."""
        return parse_bytes(self.cache_size, "--cache-size") or 0.0


@dataclass(frozen=True, kw_only=True)
class EstimateOptions:
    """Options of the estimate of the posterior."""

    method: Literal["angular", "spectrum"] = "angular"
    """angular: compare radiance in all views; spectrum: compare power spectra as in the paper,
    for instance to reproduce it."""
    preset: Literal["default", "fixed", "fast", "paper"] = "default"
    """paper: the published method; fast: less accurate, grey; fixed (angular only): noise of 8 %
    of the mean radiance instead of estimated noise."""
    known: Known = ()
    bounces: bool = False
    """Account for light that the object reflects onto itself, as bright as it is in the
    photographs (presets default and fixed); takes up to twice as long."""

    @property
    def model(self) -> str:
        """Key of ``memory.MODELS``, which contains the memory per texel."""
        if self.bounces:
            return "bounces"
        return self.preset if self.method == "angular" else self.method

    def check(self) -> None:
        """Refuse an unknown preset or parameter."""
        self.switches()
        parse_known(self.known)

    def switches(self) -> AnyPreset:
        """Return the preset with its options."""
        if not self.bounces:
            return find_preset(self.preset, method=self.method)
        if self.method != "angular" or self.preset not in ("default", "fixed"):
            raise OptionError("--bounces needs --method angular and --preset default or fixed.")
        return find_preset(self.preset, method="angular", bounces=True)

    def estimate(
        self, progress: Progress, capture: Capture, texels: Texels, **options: Any
    ) -> Estimate:
        """Return the estimate of a capture; ``options`` are passed to ``pipeline.estimate``."""
        from svu_mi.pipeline import estimate

        return estimate(
            capture, texels, self.method, self.switches(), known=parse_known(self.known),
            progress=progress, **options,
        )  # fmt: skip


def require_range(option: str, value: float | None, low: float, high: float = math.inf) -> None:
    """Refuse a number that is not in [low, high]; accept None."""
    if value is not None and not low <= value <= high:
        limits = f"at least {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
        raise OptionError(f"{option} must be {limits}, got {value:g}.")


def parse_size(size: tuple[int, ...]) -> tuple[int, int]:
    """Return (width, height) from one or two numbers of ``--resolution``."""
    if len(size) not in (1, 2) or min(size) < 1:
        numbers = " ".join(map(str, size))
        raise OptionError(f"--resolution takes one or two positive numbers, got {numbers}.")
    return size[0], size[-1]


def parse_resolution(resolution: tuple[int, ...]) -> tuple[int, int]:
    """Return (width, height) of ``--resolution``."""
    size = parse_size(resolution)
    require_texels(size, "--resolution")
    return size


def parse_bytes(text: str, option: str = "--memory") -> float | None:
    """Return the bytes of a size such as "4G" or "800M"; None for an empty text."""
    if not text:
        return None
    number, unit = (text[:-1], text[-1].upper()) if text[-1].upper() in UNITS else (text, "")
    try:
        size = float(number) * UNITS.get(unit, 1)
    except ValueError:
        size = -1
    if not 0 <= size < math.inf:
        raise OptionError(f"{option} takes a size such as 4G or 800M, got {text!r}.")
    return size


def repeat_known(words: Sequence[str]) -> list[str]:
    """Replace ``--known a=0 b=1`` by ``--known a=0 --known b=1`` in the words of a command.

    If --known took several values, the parser would also take the scene after them.
    """
    spread: list[str] = []
    for word in words:
        name, is_value, _ = word.partition("=")
        if spread[-2:-1] == ["--known"] and is_value and name in (*NAMES, SPECULAR):
            spread.append("--known")
        spread.append(word)
    return spread


def parse_known(words: tuple[str, ...]) -> dict[str, float] | Literal["scene"] | None:
    """Return the values of ``--known`` by parameter, ``"scene"``, or None if not given."""
    if words == ("scene",):
        return "scene"
    known = {}
    for word in words:
        name, _, value = word.partition("=")
        try:
            known[name] = float(value)
        except ValueError:
            raise OptionError(
                f"--known takes NAME=NUMBER, such as metallic=0, or the single word scene; got "
                f"{word!r}."
            ) from None
    if len(known) < len(words):
        raise OptionError(f"--known must name each parameter once, got {', '.join(words)}.")
    for name, number in known.items():
        if name not in (*NAMES, SPECULAR):
            raise OptionError(
                f"--known: unknown parameter {name!r}; use {', '.join(NAMES[:-1])} or {NAMES[-1]}."
            )
        require_range(f"--known: {name}", number, 0, 1)
    return known or None


def known_values(words: tuple[str, ...], shape: Any, names: Sequence[str]) -> dict[str, float]:
    """Return the values of ``--known`` by parameter, those of ``names``."""
    from svu_mi.capture.replace_material import constant_parameters

    known = parse_known(words) or {}
    values = constant_parameters(shape) if known == "scene" else known
    return {name: value for name, value in values.items() if name in names}


def read_recovered(
    folder: Path | None, resolution: tuple[int, ...], default: int = 0, one_run: bool = True
) -> tuple[tuple[int, int], Textures | None]:
    """Return (width, height) of the texel grid, and the textures in ``folder``, if given."""
    from svu_mi.output.texture_files import read_textures

    if folder is None:
        return parse_size(resolution or (default,)), None
    textures = read_textures(folder, one_run=one_run)
    if resolution and parse_size(resolution) != textures.resolution:
        width, height = textures.resolution
        raise OptionError(
            f"{folder}: the textures have {width} x {height} texels; give --resolution {width} "
            f"{height}."
        )
    return textures.resolution, textures


def as_dict(options: Any) -> dict[str, Any]:
    """Return all options of a command by name, including its groups, for ``run.json``."""
    values: dict[str, Any] = {}
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        values |= as_dict(value) if dataclasses.is_dataclass(value) else {field.name: value}
    return values

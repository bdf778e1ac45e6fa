"""Path-traced images of the object with given textures, under any environment map.

images = relight(capture, textures, novel_light(capture), capture.sensors[:3])
truth = relight(capture, None, novel_light(capture), capture.sensors[:3])
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.film_rays import SensorPixels
from svu_mi.capture.replace_material import make_scene
from svu_mi.capture.scene import to_world
from svu_mi.capture.surroundings import path_length
from svu_mi.core.validation import require_spp
from svu_mi.errors import OptionError
from svu_mi.light.environment import read_environment
from svu_mi.light.latlong import directions
from svu_mi.recovery.path.textured_scene import PathScene
from svu_mi.recovery.svbrdf_textures import Textures

COLUMNS, ROWS = 128, 65  # resolution of ``novel_light``
ROOM_RADIANCE = 0.15  # radiance of the room around the lamps
# Direction (up = +Y), half of the opening angle in radians, and colour of each lamp.
LAMPS = (
    ((0.7, 0.6, -0.4), 0.32, (9.0, 8.0, 6.5)),
    ((-0.8, 0.35, 0.5), 0.18, (9.0, 12.0, 16.0)),
    ((-0.1, 0.2, -1.0), 0.45, (2.0, 2.4, 2.2)),
    ((0.3, -0.3, 0.9), 0.25, (4.0, 3.0, 2.0)),
)
FEWEST_DRAWS = 2  # for a standard deviation


def relight(
    capture: Capture, textures: Textures | None, environment: Any | None = None,
    sensors: Sequence[Any] | None = None, spp: int = 64, *, seed: int = 0,
    max_depth: int | None = None, pixels: Sequence[np.ndarray] | None = None,
) -> list[np.ndarray]:  # fmt: skip
    """Path-trace the object with given textures.

    Args:
        capture: Capture with the scene, which is not modified.
        textures: Textures over the UVs of ``capture.mesh``; None keeps the scene's material, such
            as the ground truth of a synthetic capture.
        environment: Emitter, or dictionary for ``mi.load_dict``; default: the capture's.
        sensors: Sensors to render; default: the capture's. Films of one size share a kernel.
        spp: Samples per pixel.
        seed: Seed of the first image, incremented for each further one.
        max_depth: Maximum path length, 2 for direct light; default: the scene integrator's.
        pixels: One (H, W) bool mask per sensor: pixels to render, in one launch; default: all.

    Returns:
        One (H, W, 3) float32 image per sensor, linear radiance with background; 0 where masked.
    """
    require_spp(spp, "relight(): spp")
    scene = capture.scene if textures is None else PathScene.of(capture, textures).scene
    scene, integrator = with_environment(scene, environment), _integrator(capture, max_depth)
    sensors = capture.sensors if sensors is None else sensors
    if pixels is not None:
        return SensorPixels(sensors).traced(scene, integrator, pixels, spp, seed)
    images = (
        mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=(seed + k) % 2**32)
        for k, sensor in enumerate(sensors)
    )
    return [np.array(image, np.float32)[..., :3] for image in images]


def _integrator(capture: Capture, max_depth: int | None) -> Any:
    depth = path_length(capture.scene) if max_depth is None else max_depth
    return mi.load_dict({"type": "path", "max_depth": depth})


def novel_light(capture: Capture) -> Any:
    """Create an environment map for relighting: four coloured lamps in a dark room.

    Orientation and mean radiance match the capture's environment map. Without one, the mean
    radiance is that of the photographs.
    """
    emitter, pose = capture.environment, np.eye(4)
    if emitter is None:
        used = [x for x, known in zip(capture.images, capture.used, strict=True) if known]
        brightness = float(np.mean([np.nanmean(image) for image in used]))
    else:
        brightness = read_environment(emitter).coefficients(0).mean() / np.sqrt(4 * np.pi)
        pose = to_world(emitter)
    d = directions(COLUMNS, ROWS)
    radiance = np.repeat(ROOM_RADIANCE * (1 + 0.5 * d[..., 1:2]), 3, axis=-1)  # normalised below
    for center, angle, color in LAMPS:
        away = np.arccos(np.clip(d @ (np.array(center) / np.linalg.norm(center)), -1, 1))
        inside = np.clip(0.5 + (angle - away) / 0.08, 0, 1)  # edges wider than a texel
        radiance += inside[..., None] * np.array(color)
    solid = np.sin(np.linspace(0, np.pi, ROWS))[:, None, None]
    radiance *= brightness / ((radiance * solid).sum() / (3 * COLUMNS * solid.sum()))
    bitmap = mi.Bitmap(np.ascontiguousarray(radiance, np.float32))
    turned = mi.ScalarTransform4f(pose)
    return mi.load_dict({"type": "envmap", "bitmap": bitmap, "to_world": turned})


def with_environment(scene: Any, environment: Any | None) -> Any:
    """Return a scene with the same shapes and another environment (see ``relight``)."""
    if environment is None:
        return scene
    light = mi.load_dict(environment) if isinstance(environment, dict) else environment
    return make_scene([light, *scene.shapes()])


@dataclass(frozen=True)
class RelitView:
    """Image of an object with its uncertainty due to the textures.

    Attributes:
        picture: (H, W, 3) float32, linear radiance with the recovered textures and background.
        mean, sd: (H, W, 3) float32, mean and standard deviation over draws of the textures;
            ``picture`` and 0 in the background.
        inside: (H, W) bool, pixels in which the object is visible.

    Example:
        >>> field = svu.texture_field(recovery, mesh=capture.mesh)
        >>> sensors = capture.sensors[:1]
        >>> view, = svu.relight_draws(capture, recovery.textures, field.draw(4), None, sensors, 4)
        >>> view.sd.shape, bool((view.sd[~view.inside] == 0).all())
        ((96, 96, 3), True)
    """

    picture: np.ndarray
    mean: np.ndarray
    sd: np.ndarray
    inside: np.ndarray


def relight_draws(
    capture: Capture, textures: Textures, draws: Iterable[Textures],
    environment: Any | None = None, sensors: Sequence[Any] | None = None, spp: int = 16, *,
    seed: int = 0, max_depth: int | None = None, progress: Callable[[int], None] = lambda _: None,
) -> list[RelitView]:  # fmt: skip
    """Path-trace the object with its textures and with draws from their distribution.

    All draws use the same random numbers, so the standard deviation contains no Monte Carlo noise.

    Args:
        capture: Capture with the scene, which is not modified.
        textures: Recovered textures.
        draws: At least two draws, such as ``TextureField.draw(16)``.
        environment: Emitter, or dictionary for ``mi.load_dict``; default: the capture's.
        sensors: Sensors to render; default: the capture's.
        spp: Samples per pixel, rounded to a square number.
        seed: Seed of the samples.
        max_depth: Maximum path length; default: the scene integrator's.
        progress: Function that is called with the number of rendered draws.

    Raises:
        OptionError: There are fewer than two draws, or ``spp`` is less than 1.
        ShapeError: A draw has another resolution.

    Example:
        >>> field = svu.texture_field(recovery, mesh=capture.mesh)
        >>> views = svu.relight_draws(capture, recovery.textures, field.draw(2), spp=1)
        >>> len(views) == len(capture.sensors)
        True
    """
    require_spp(spp, "relight_draws(): spp")
    painted = PathScene.of(capture, textures)
    scene = with_environment(painted.scene, environment)
    integrator = _integrator(capture, max_depth)
    pictures = SensorPixels(capture.sensors if sensors is None else sensors)
    inside = [part > 0 for part in pictures.covered(painted.scene, painted.shape)]
    middle = pictures.traced(scene, integrator, [np.ones_like(m) for m in inside], spp, seed)
    # Sums are of differences from an image with the same noise, for precision.
    base = pictures.traced(scene, integrator, inside, spp, seed)
    total, squares = ([np.zeros(image.shape) for image in base] for _ in range(2))
    count = 0
    for count, draw in enumerate(draws, 1):  # noqa: B007
        painted.paint(dict(draw.items()))
        images = pictures.traced(scene, integrator, inside, spp, seed)
        for image, start, first, second in zip(images, base, total, squares, strict=True):
            change = image.astype(np.float64) - start
            first += change
            second += change**2
        progress(count)
    if count < FEWEST_DRAWS:
        raise OptionError(f"relight_draws(): needs at least {FEWEST_DRAWS} draws, got {count}.")
    parts = zip(middle, inside, total, squares, strict=True)
    return [_relit(*each, count) for each in parts]


def _relit(
    image: np.ndarray, inside: np.ndarray, total: np.ndarray, squares: np.ndarray, count: int
) -> RelitView:
    """Return a view with mean and sd of ``count`` draws.

    ``total`` and ``squares`` are sums of differences from ``image``, and of their squares.
    """
    mean = total / count
    sd = np.sqrt(np.maximum(squares - count * mean**2, 0) / (count - 1))
    return RelitView(image, (image + mean).astype(np.float32), sd.astype(np.float32), inside)

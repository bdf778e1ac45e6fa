"""All views of a capture in flat arrays that kernels index by view.

Memory: 1 byte per pixel for the flag of usable pixels. Photographs that were read from files are
in one block already (12 bytes per pixel) and are not copied.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import scene
from svu_mi.capture.capture import Capture
from svu_mi.capture.film_rays import ray_floats
from svu_mi.capture.pixel_buffer import PixelBuffer
from svu_mi.capture.sensors import describe, film_size, scaled_sensor
from svu_mi.core.arrays import to_drjit
from svu_mi.errors import CaptureError, warn
from svu_mi.geometry.silhouettes import Films, Outline, find_tiles, interior

CAMERA_FLOATS = 16  # rows x, y, w of the projection (4 each), position (3), near clip
LARGEST_FILM = 512  # pixels per side, for sensors without a photograph
HOT = 1e6  # radiance of a defective ("hot") pixel, in medians of the object's pixels
SAMPLED = 2**18  # pixels in the sample from which this median is computed
GREY = 1e-6  # largest difference between the channels of a grey pixel, relative to the largest


@dataclass(frozen=True, kw_only=True)
class Views(Films):
    """The V used views of a capture with P pixels, as flat arrays for kernels.

    Attributes:
        cameras: (V * 16,) Float; per view: rows x, y, w of the projection matrix (w is the depth;
            x / w and y / w are pixels of the crop window), world position, depth of the near clip.
        pixels: (3 P,) Float, radiance, interleaved RGB; shares the capture's memory if possible.
            None without photographs.
        usable: (P,) Bool, True for interior pixels with valid radiance. None with an ``outline``.
        count, number: Number of views V, as opaque UInt32 and as int.
        grey: True if R = G = B in all usable pixels (relative tolerance 1e-6).
        clipped: Partly saturated pixels; None if no channel is saturated.
        rounding: ``first`` and ``slope`` of each channel (see ``Rounding``), two (3 V,) Float; 0
            for floating-point photographs. None if no photograph stores integers.
        outline: Silhouettes for lazy tests of interior pixels; None if ``usable`` is given.
    """

    cameras: Any
    pixels: Any = None
    usable: Any = None
    count: Any
    number: int
    scene: Any
    grey: bool = True
    clipped: "ClippedPixels | None" = None
    rounding: tuple[Any, Any] | None = None
    outline: Outline | None = None


@dataclass(frozen=True)
class ClippedPixels:
    """Interior pixels with saturated channels, whose other channels are valid.

    Attributes:
        channels: (P,) UInt8; bit c is set where channel c is saturated. 0 for all other pixels.
        least: (3 V,) Float, lower bounds of the radiance of saturated channels, by view.
    """

    channels: Any
    least: Any


def pack_views(capture: Capture, *, silhouettes: bool = False) -> Views:
    """Pack the used views; ``silhouettes=True`` also accepts silhouette pixels."""
    kept = [index for index in range(capture.count) if capture.used[index]]
    if not kept:
        raise CaptureError(
            f"No usable photograph: all {capture.count} are missing, black or marked as unused."
        )
    for index in kept:
        _require_size(capture, index)
    buffer, places = _buffer(capture, kept)
    offset, count = buffer.offsets[places], len(buffer.masked)
    if 3 * count >= 2**32:
        raise CaptureError(
            f"The photographs have {count} pixels in all, more than the limit of {2**32 // 3}; "
            "reduce their resolution."
        )
    poses = [_Pose.of(capture.sensors[index]) for index in kept]
    views = _views(capture.scene, poses, offset)
    # On the CPU, these arrays share the memory of the buffer.
    pixels = _Pixels(
        mi.Float(buffer.pixels),
        mi.Bool(buffer.masks_at(places, [capture.masks[index] for index in kept])),
        _flags(capture, kept, buffer, places),
    )  # fmt: skip
    if silhouettes:
        for start, pose in zip(offset.tolist(), poses, strict=True):
            index = dr.arange(mi.UInt32, pose.size[0] * pose.size[1])
            pixels.mark_usable(index + dr.opaque(mi.UInt32, start), mi.Bool(True))
    else:
        masks = [capture.masks[index] for index in kept]
        tiles = _tiles(capture.shape, poses, masks)
        for index, inside in interior(capture.scene, capture.shape, views, tiles):
            pixels.mark_usable(index, inside)
    for place, count, ratio in pixels.drop_hot(offset):
        pixel = "pixel is" if count == 1 else "pixels are up to"
        warn(
            f"{capture.names[kept[place]]}: {count} {pixel} {ratio:.0e} times as bright as the "
            "median of the object; ignored."
        )
    buffer.advise_random_access()
    clipped, rounding = pixels.clipped_pixels(capture, kept), _rounding(capture, kept)
    views = replace(views, grey=not pixels.coloured[0], clipped=clipped, rounding=rounding)
    return replace(views, usable=pixels.usable, pixels=pixels.radiance)


def pack_sensors(
    scene: Any, target: Any, sensors: Sequence[Any], largest: int = LARGEST_FILM, *,
    later: bool = False,
) -> Views:  # fmt: skip
    """Pack sensors without photographs; silhouette pixels are unusable.

    Films above ``largest`` pixels per side are scaled down, which makes silhouettes wider.
    ``later=True`` tests silhouettes only where kernels need them, by ``Views.outline``.
    """
    poses = [_Pose.of(scaled_sensor(sensor, largest)) for sensor in sensors]
    sizes = np.array([pose.size for pose in poses], np.int64).reshape(-1, 2)
    ends = np.cumsum(sizes.prod(axis=1))
    views = _views(scene, poses, ends - sizes.prod(axis=1))
    if later:
        return replace(views, outline=Outline(target, views))
    usable = dr.zeros(mi.Bool, int(ends[-1]) if len(ends) else 0)
    dr.eval(usable)
    for index, inside in interior(scene, target, views, _tiles(target, poses, [None] * len(poses))):
        dr.scatter(usable, mi.Bool(True), index, inside)
        dr.eval(usable)
    return replace(views, usable=usable)


class _Pixels:
    """Properties of the P pixels, accumulated over kernel launches.

    Attributes:
        coloured: (1,) UInt32, 1 if a usable pixel is not grey.
        brightest, faintest: (1,) UInt32, float bits of the largest and smallest positive radiance.
        clipped: (P,) UInt8, see ``ClippedPixels``; None without saturated channels.
    """

    def __init__(self, radiance: Any, allowed: Any, flags: Any | None) -> None:
        count = dr.width(radiance) // 3
        self.radiance = radiance
        self.usable = dr.zeros(mi.Bool, count)
        self.coloured = dr.zeros(mi.UInt32, 1)
        self.brightest = dr.zeros(mi.UInt32, 1)
        self.faintest = dr.reinterpret_array(mi.UInt32, dr.opaque(mi.Float, dr.inf))
        self.clipped = None if flags is None else dr.zeros(type(flags), count)
        self._allowed, self._flags = allowed, flags

    def mark_usable(self, index: Any, inside: Any) -> None:
        """Mark interior pixels that are inside the mask and have a valid radiance."""
        inside = inside & dr.gather(mi.Bool, self._allowed, index, inside)
        color = dr.gather(mi.Color3f, self.radiance, index, inside)
        good = inside & dr.all(dr.isfinite(color))
        most = dr.max(color)
        dr.scatter(self.usable, mi.Bool(True), index, good)
        coloured = good & (most - dr.min(color) > GREY * most)
        dr.scatter(self.coloured, mi.UInt32(1), 0, coloured)
        bits = dr.reinterpret_array(mi.UInt32, dr.maximum(most, 0))
        place, local = mi.UInt32(0), dr.ReduceMode.Local  # all lanes write to one element
        dr.scatter_reduce(dr.ReduceOp.Max, self.brightest, bits, place, good, local)
        dr.scatter_reduce(dr.ReduceOp.Min, self.faintest, bits, place, good & (most > 0), local)
        if self.clipped is not None:
            flags = dr.gather(type(self._flags), self._flags, index, inside)
            known = [dr.isfinite(x) | ((flags & (1 << c)) > 0) for c, x in enumerate(color)]
            dr.scatter(self.clipped, flags, index, inside & known[0] & known[1] & known[2])
        # One evaluation, so that photographs are read once.
        dr.eval(self.usable, self.coloured, self.brightest, self.faintest, self.clipped)

    def clipped_pixels(self, capture: Capture, kept: Sequence[int]) -> ClippedPixels | None:
        """Return the clipped pixels; None if no pixel is clipped."""
        some = dr.zeros(mi.UInt32, 1)
        if self.clipped is not None:
            dr.scatter(some, mi.UInt32(1), 0, self.clipped > 0)  # dr.any stores a flag per pixel
        if self.clipped is None or not some[0]:
            return None
        least = np.ones((len(kept), 3), np.float32)
        for place, index in enumerate(kept):
            saturation = capture.clipped[index]
            if saturation is not None:
                least[place] = saturation.least
        return ClippedPixels(self.clipped, to_drjit(mi.Float, least.ravel()))

    def drop_hot(self, offset: np.ndarray) -> list[tuple[int, int, float]]:
        """Mark hot pixels as unusable; return view, count, and largest / median radiance."""
        brightest, faintest = (
            bits.numpy().view(np.float32)[0] for bits in (self.brightest, self.faintest)
        )
        if brightest <= HOT * faintest:  # then brightest <= HOT * median, too
            return []
        colors = self.radiance.numpy().reshape(-1, 3)
        step = len(colors) // SAMPLED | 1  # odd, to avoid sampling few columns only
        lit = colors[::step][self.usable.numpy()[::step]].max(axis=1, initial=0)
        lit = lit[lit > 0]
        most = HOT * float(np.median(lit)) if len(lit) else np.inf
        if not brightest > np.float32(most):
            return []
        index = dr.arange(mi.UInt32, len(colors))
        bright = dr.max(dr.gather(mi.Color3f, self.radiance, index, self.usable))
        hot = self.usable & (bright > dr.opaque(mi.Float, most))
        pixels = np.flatnonzero(hot.numpy())
        self.usable &= ~hot
        dr.eval(self.usable)
        counts = []
        order = np.argsort(offset)
        owner = order[np.searchsorted(offset[order], pixels, side="right") - 1]
        for view in np.unique(owner):
            own = colors[pixels[owner == view]].max()
            counts.append((int(view), int((owner == view).sum()), float(own / most * HOT)))
        return counts


@dataclass(frozen=True)
class _Pose:
    """Parameters of one sensor for kernels; see ``Views``.

    Attributes:
        camera: (16,) float64, see ``Views.cameras``.
        rays: (24,) float32, see ``ray_floats``.
    """

    size: tuple[int, int]
    camera: np.ndarray
    rays: np.ndarray
    angle: float

    @staticmethod
    def of(sensor: Any) -> "_Pose":
        """Read a perspective sensor."""
        width, height = film_size(sensor)
        record = describe(sensor)
        to_world = np.array(record["to_world"])
        projection = scene.read_matrix(sensor.projection_transform())
        # Mitsuba projects to [0, 1]^2 of the crop window; row 2 (depth) is not needed.
        # The projection excludes the principal point, which is in units of the full film.
        pixel = np.diag([width, height, 1.0, 1.0])
        for axis in range(2):
            pixel[axis, 3] = -record["principal_point_offset"][axis] * record["film"][axis]
        rows = (pixel @ projection @ np.linalg.inv(to_world))[[0, 1, 3]]
        return _Pose(
            size=(width, height),
            camera=np.concatenate([rows.ravel(), to_world[:3, 3], record["clip"][:1]]),
            rays=ray_floats(sensor, record),
            angle=float(1 / abs(projection[0, 0] * width)),
        )


def _views(scene: Any, poses: Sequence[_Pose], offset: np.ndarray) -> Views:
    """Return views without pixels; ``offset`` is the index of each view's first pixel."""
    sizes = np.array([pose.size for pose in poses], np.uint32).reshape(-1, 2)
    return Views(
        width=to_drjit(mi.UInt32, sizes[:, 0]),
        height=to_drjit(mi.UInt32, sizes[:, 1]),
        offset=to_drjit(mi.UInt32, offset.astype(np.uint32)),
        angle=to_drjit(mi.Float, np.array([pose.angle for pose in poses], np.float32)),
        rays=to_drjit(mi.Float, np.array([pose.rays for pose in poses], np.float32).ravel()),
        cameras=to_drjit(mi.Float, np.array([pose.camera for pose in poses], np.float32).ravel()),
        count=dr.opaque(mi.UInt32, len(poses)),
        number=len(poses),
        scene=scene,
    )


def _tiles(target: Any, poses: Sequence[_Pose], masks: Sequence[np.ndarray | None]) -> np.ndarray:
    cameras = np.array([pose.camera for pose in poses]).reshape(-1, CAMERA_FLOATS)
    bounds = target.bbox()
    return find_tiles(
        cameras[:, :12].reshape(-1, 3, 4),
        cameras[:, 15],
        np.array([pose.size for pose in poses]).reshape(-1, 2),
        np.array([bounds.min, bounds.max], np.float64),
        [None if mask is None else np.asarray(mask, bool) for mask in masks],
    )


def _require_size(capture: Capture, index: int) -> None:
    """Raise if a photograph or mask differs in size from its sensor's film."""
    width, height = film_size(capture.sensors[index])
    image, mask = capture.images[index], capture.masks[index]
    if image.shape != (height, width, 3) or (mask is not None and mask.shape != (height, width)):
        shown = image.shape if mask is None else (image.shape, mask.shape)
        raise CaptureError(
            f"{capture.names[index]}: photograph and mask must have the shapes ({height}, {width}, "
            f"3) and ({height}, {width}), the size of the sensor's film, got {shown}."
        )


def _rounding(capture: Capture, kept: Sequence[int]) -> tuple[Any, Any] | None:
    """Return ``Views.rounding``; None if all photographs are floating point."""
    steps = [capture.rounding[index] for index in kept if capture.rounding]
    if not any(each is not None for each in steps):
        return None
    none = np.zeros(3, np.float32)
    first = np.stack([none if each is None else each.first for each in steps])
    slope = np.stack([none if each is None else each.slope for each in steps])
    return to_drjit(mi.Float, first.ravel()), to_drjit(mi.Float, slope.ravel())


def _buffer(capture: Capture, kept: Sequence[int]) -> tuple[PixelBuffer, list[int]]:
    """Return a buffer with the ``kept`` photographs, and their indices in the buffer."""
    images = [capture.images[index] for index in kept]
    places = None if capture.buffer is None else capture.buffer.places(images)
    if capture.buffer is None or places is None:
        return PixelBuffer.of(images), list(range(len(images)))
    return capture.buffer, places


def _flags(
    capture: Capture, kept: Sequence[int], buffer: PixelBuffer, places: Sequence[int]
) -> Any | None:
    """Return bits of clipped channels, (P,) UInt8; None if no photograph has any."""
    saturations = [capture.clipped[index] for index in kept if capture.clipped]
    if not any(each is not None for each in saturations):
        return None
    channels = [None if each is None else each.channels for each in saturations]
    return dr.uint8_array_t(mi.Float)(buffer.channels_at(places, channels))

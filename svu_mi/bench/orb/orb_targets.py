"""Photographs that pictures of the recovered object are compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.bench.orb.orb_metrics import OrbError, orb_albedo_error, orb_error
from svu_mi.capture.capture import Capture
from svu_mi.capture.image_io import decoded, read_planes
from svu_mi.capture.importers.envmap import read_environment_map
from svu_mi.capture.importers.resampling import average_area, square_pixel_frame
from svu_mi.capture.importers.stanford_orb import OrbView
from svu_mi.errors import CaptureError
from svu_mi.recovery.path.textured_scene import PathScene
from svu_mi.recovery.relighting import relight
from svu_mi.recovery.svbrdf_textures import Textures

IN_MASK = 0.5  # of a pixel's area
ALBEDO_SAMPLES = 16  # per pixel, of pictures of the base colour
FIGURES = ("psnr_hdr", "psnr_ldr", "ssim", "lpips")


@dataclass(frozen=True)
class Target:
    """A photograph, and all that is needed to render the same.

    Attributes:
        view: where it comes from.
        sensor: its camera.
        photograph: (H, W, 3) linear radiance.
        mask: (H, W) bool, the object's pixels.
        albedo: (H, W, 3) linear, or None.
    """

    view: OrbView
    sensor: Any
    photograph: np.ndarray
    mask: np.ndarray
    albedo: np.ndarray | None

    @classmethod
    def of(cls, view: OrbView, film: int) -> Target:
        """Read a photograph, reduced to ``film`` pixels on its longer side.

        Raises:
            CaptureError: it, its mask or its environment map is missing or damaged, or photograph
                and mask differ in size.
        """
        frame = view.frame
        if frame.mask is None or view.light is None:
            missing = "mask" if frame.mask is None else "environment map"
            raise CaptureError(f"{frame.image}: there is no {missing}, which its test needs.")
        reduced, scale = square_pixel_frame(frame, max(1.0, max(frame.size) / film))
        color, mask = _linear(frame.image), np.stack(read_planes(frame.mask)[0][:1], axis=-1)
        if mask.shape[:2] != color.shape[:2]:
            raise CaptureError(f"{frame.mask}: the mask is not as large as its photograph.")
        valid = np.isfinite(color).all(axis=-1, keepdims=True)
        color = np.where(valid, color, 0)
        albedo = None if view.albedo is None else average_area(_encoded(view.albedo), scale)
        return cls(
            view=view,
            sensor=reduced.sensor(),
            photograph=average_area(color, scale),
            mask=average_area(mask * valid, scale)[..., 0] > IN_MASK,
            albedo=None if albedo is None else decoded(albedo),
        )

    def emitter(self) -> Any:
        """Make the environment that the photograph was taken under."""
        assert self.view.light is not None  # ``of`` has looked
        pixels, pose, _ = read_environment_map(self.view.light)
        return mi.load_dict(
            {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": mi.ScalarTransform4f(pose)}
        )

    def picture(self, capture: Capture, textures: Textures, spp: int) -> np.ndarray:
        """Render the object of a capture as this photograph shows it: (H, W, 3)."""
        return relight(capture, textures, self.emitter(), [self.sensor], spp)[0]


def score_pictures(
    targets: Sequence[Target], pictures: Sequence[np.ndarray], *, scaled: bool
) -> dict[str, Any]:
    """Compare pictures with photographs.

    Args:
        targets: the photographs.
        pictures: one for each.
        scaled: whether a scale per channel is fitted (see ``orb_error``).

    Returns:
        ``mean`` of each of ``FIGURES`` (None where it is not known) and ``single`` figures.
    """
    return _gathered(targets, [
        orb_error(picture, target.photograph, target.mask, scaled=scaled)
        for target, picture in zip(targets, pictures, strict=True)
    ])  # fmt: skip


def score_albedo(
    targets: Sequence[Target], capture: Capture, textures: Textures
) -> dict[str, Any] | None:
    """Compare the base colour with that of the data set; None if it has none."""
    known = [target for target in targets if target.albedo is not None]
    if not known:
        return None
    scene = PathScene.of(capture, textures).scene
    pictures = albedo_pictures(scene, [target.sensor for target in known])
    return _gathered(known, [
        orb_albedo_error(picture, target.albedo, target.mask)
        for target, picture in zip(known, pictures, strict=True)
    ])  # fmt: skip


def albedo_pictures(scene: Any, sensors: Sequence[Any]) -> list[np.ndarray]:
    """Render the base colour of a scene's objects: one (H, W, 3) per sensor, linear.

    Args:
        scene: of ``principled`` objects.
        sensors: where from.
    """
    integrator = mi.load_dict({"type": "aov", "aovs": "base_color:albedo"})
    spp = ALBEDO_SAMPLES
    return [
        np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp), np.float32)
        for sensor in sensors
    ]


def _gathered(targets: Sequence[Target], errors: Sequence[OrbError]) -> dict[str, Any]:
    single = [
        {"capture": target.view.capture, "photograph": target.view.name, **asdict(error)}
        for target, error in zip(targets, errors, strict=True)
    ]
    mean = {}
    for name in FIGURES:
        values = [one[name] for one in single]
        mean[name] = None if None in values else float(np.mean(values))
    return {"mean": mean, "single": single}


def _linear(path: Any) -> np.ndarray:
    """Return (H, W, 3) linear values of a photograph."""
    planes, integers = read_planes(path)
    color = np.stack(planes[:3], axis=-1)
    return decoded(color) if integers else color


def _encoded(path: Any) -> np.ndarray:
    """Return (H, W, 3) as stored."""
    return np.stack(read_planes(path)[0][:3], axis=-1)

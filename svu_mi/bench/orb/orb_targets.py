"""Photographs of the data set, and comparisons with pictures of the recovered object."""

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

IN_MASK = 0.5  # least covered share of a pixel of the object
ALBEDO_SAMPLES = 16  # samples per pixel of pictures of the base colour
FIGURES = ("psnr_hdr", "psnr_ldr", "ssim", "lpips")


@dataclass(frozen=True)
class Target:
    """A photograph with its camera and light.

    Attributes:
        view: Files of the photograph.
        sensor: Camera.
        photograph: Linear radiance, (H, W, 3).
        mask: Pixels of the object, (H, W) bool.
        albedo: Linear base colour, (H, W, 3), or None.
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
            CaptureError: Photograph, mask or environment map is missing or damaged, or photograph
                and mask differ in size.
        """
        frame = view.frame
        if frame.mask is None or view.light is None:
            missing = "mask" if frame.mask is None else "environment map"
            raise CaptureError(
                f"{frame.image}: the {missing} is missing; download it for this photograph."
            )
        reduced, scale = square_pixel_frame(frame, max(1.0, max(frame.size) / film))
        color, mask = _linear(frame.image), np.stack(read_planes(frame.mask)[0][:1], axis=-1)
        if mask.shape[:2] != color.shape[:2]:
            raise CaptureError(f"{frame.mask}: mask and photograph differ in size.")
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
        """Return the environment light of the photograph."""
        assert self.view.light is not None  # checked by ``of``
        pixels, pose, _ = read_environment_map(self.view.light)
        return mi.load_dict(
            {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": mi.ScalarTransform4f(pose)}
        )

    def picture(self, capture: Capture, textures: Textures, spp: int) -> np.ndarray:
        """Render the object with the camera and light of the photograph, (H, W, 3)."""
        return relight(capture, textures, self.emitter(), [self.sensor], spp)[0]


def score_pictures(
    targets: Sequence[Target], pictures: Sequence[np.ndarray], *, scaled: bool
) -> dict[str, Any]:
    """Compare pictures with photographs.

    Args:
        targets: Photographs.
        pictures: One picture per photograph.
        scaled: Fit a scale per channel (see ``orb_error``).

    Returns:
        ``mean`` of each score (None if not available), and ``single`` errors per photograph.
    """
    return _gathered(targets, [
        orb_error(picture, target.photograph, target.mask, scaled=scaled)
        for target, picture in zip(targets, pictures, strict=True)
    ])  # fmt: skip


def score_albedo(
    targets: Sequence[Target], capture: Capture, textures: Textures
) -> dict[str, Any] | None:
    """Compare the base colour with the data set; None for data sets without base colour."""
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
    """Render the linear base colour of a scene, (H, W, 3) per sensor.

    Args:
        scene: Scene with ``principled`` materials.
        sensors: Cameras.
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
    """Return the linear values of a photograph, (H, W, 3)."""
    planes, integers = read_planes(path)
    color = np.stack(planes[:3], axis=-1)
    return decoded(color) if integers else color


def _encoded(path: Any) -> np.ndarray:
    """Return the stored values of a picture, (H, W, 3)."""
    return np.stack(read_planes(path)[0][:3], axis=-1)

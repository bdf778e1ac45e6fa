"""Latent diffusion model of materials that preserves certain pixels (Sec. 5.3 of the paper).

PyTorch is imported on first use.

A latent z starts as noise e and is denoised at times t_1 > t_2 > ... of a schedule. Certain latents
(mask M, latent x of the known map) are restored after each step, with the noise of the next time:
Blended Latent Diffusion [Avrahami et al. 2023]. The last ``free`` steps omit this to avoid seams.

    z_i = step(z_{i-1}, model(z_{i-1}, t_i), t_i)                      every step
    z_i = M n(x, t_{i+1}) + (1 - M) z_i,   n(x, t) = a_t x + s_t e     except for the last ones

with a_t^2 + s_t^2 = 1; after the last time, n is x. The noise e is the same throughout, so a model
that reproduces x exactly also does so in the last steps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi.capture.image_io import decoded, srgb
from svu_mi.parameters import CHANNELS
from svu_mi.recovery.inpaint.diffusion.model_interface import DenoisingRun, Family, ModelInput


def blend(
    predict: Callable[[Any, Any], Any], schedule: Any, known: Any, certain: Any, noise: Any,
    free: int,
) -> Any:  # fmt: skip
    """Denoise a latent; restore ``known`` where ``certain``, except in the last steps.

    Works with arrays of any library. ``schedule`` needs ``times`` (descending),
    ``step(latent, predicted, time)`` (the latent at the next time) and
    ``noised(clean, noise, time)`` (n(x, t)). ``free`` is the number of last steps.
    """
    latent, times = noise, list(schedule.times)
    for number, time in enumerate(times, 1):
        latent = schedule.step(latent, predict(latent, time), time)
        if number <= len(times) - free:
            last = number == len(times)
            restored = known if last else schedule.noised(known, noise, times[number])
            latent = certain * restored + (1 - certain) * latent
    return latent


Names = tuple[str | None, ...]


@dataclass(frozen=True)
class LatentDiffusion:
    """Loaded weights of a diffusion model (a ``MaterialModel``).

    Attributes:
        family: Family of the model, which defines inputs and outputs.
        unet, vae, text_encoder, tokenizer, scheduler: Modules of diffusers and transformers.
        device: PyTorch device of the modules.
    """

    family: Family
    unet: Any
    vae: Any
    text_encoder: Any
    tokenizer: Any
    scheduler: Any
    device: str

    @property
    def title(self) -> str:
        """Title of the model."""
        return self.family.title

    @property
    def licence(self) -> str:
        """Licence of the weights."""
        return self.family.licence

    @property
    def runs(self) -> int:
        """Number of denoising runs per image."""
        return len(self.family.runs)

    def predict(
        self, picture: ModelInput, steps: int, free: int, seed: int,
        after_step: Callable[[], None] = lambda: None,
    ) -> dict[str, np.ndarray]:  # fmt: skip
        """Return maps (h, w, 3) or (h, w) float32 in [0, 1], by parameter."""
        import torch

        result: dict[str, np.ndarray] = {}
        with torch.inference_mode():
            # On the CPU, so that the noise does not depend on the device.
            random = torch.Generator("cpu").manual_seed(seed)
            photograph = self._latent(self._on_screen("photograph", picture.photograph))
            certain = self._on_latents(picture.certain)
            for run in self.family.runs:
                known = torch.cat([self._latent(self._stacked(m, picture)) for m in run.maps], 1)
                noise = torch.randn(known.shape, generator=random).to(known)
                schedule = _Schedule(self.scheduler, steps, self.device)
                predict = self._predictor(run, photograph, after_step)
                latent = blend(predict, schedule, known, certain, noise, free)
                for names, latents in zip(run.maps, latent.chunk(len(run.maps), 1), strict=True):
                    latents = latents / self.vae.config.scaling_factor
                    image = self.vae.decode(latents, return_dict=False)[0][0].float().clamp(-1, 1)
                    image = ((image + 1) / 2).permute(1, 2, 0).cpu().numpy()
                    height, width = picture.certain.shape
                    result |= self._unstacked(names, np.asarray(image[:height, :width]))
        return result

    def _predictor(
        self, run: DenoisingRun, photograph: Any, after_step: Callable[[], None]
    ) -> Callable[[Any, Any], Any]:
        import torch

        tokens = self.tokenizer(
            run.text, padding="max_length" if run.text else "do_not_pad", truncation=True,
            max_length=self.tokenizer.model_max_length, return_tensors="pt",
        ).input_ids  # fmt: skip
        text = self.text_encoder(tokens.to(self.device))[0]

        def predict(latent: Any, time: Any) -> Any:
            pair = (photograph, latent) if self.family.photograph_first else (latent, photograph)
            out = self.unet(torch.cat(pair, 1), time, encoder_hidden_states=text, return_dict=False)
            after_step()
            return out[0]

        return predict

    def _on_screen(self, name: str, linear: np.ndarray) -> np.ndarray:
        return srgb(linear) if name in self.family.encoded else linear

    def _stacked(self, names: Names, picture: ModelInput) -> np.ndarray:
        """Stack the maps ``names`` as channels of an input image, (h, w, 3) in [0, 1]."""
        channels = []
        for channel, name in enumerate(names):
            if name is None:
                channels.append(np.zeros(picture.certain.shape))
                continue
            known = self._on_screen(name, np.clip(picture.maps[name], 0, 1))
            channels.append(known if known.ndim == 2 else known[..., channel])
        return np.stack(channels, axis=-1)

    def _unstacked(self, names: Names, image: np.ndarray) -> dict[str, np.ndarray]:
        """Split an output image (h, w, 3) into linear maps of the parameters ``names``."""
        maps = {}
        for name in dict.fromkeys(name for name in names if name):
            first = names.index(name)
            values = image if CHANNELS[name] == 3 else image[..., first]
            linear = decoded(values) if name in self.family.encoded else values
            maps[name] = np.asarray(linear, np.float32)
        return maps

    def _latent(self, image: np.ndarray) -> Any:
        """Encode an image (h, w, 3) in [0, 1], padded to a whole number of latents."""
        import torch

        padded = np.pad(image, [*self._padding(image.shape[:2]), (0, 0)], mode="edge")
        tensor = torch.from_numpy((2 * padded - 1).astype(np.float32)).permute(2, 0, 1)[None]
        latent = self.vae.encode(tensor.to(self.device, self.vae.dtype)).latent_dist.mode()
        return latent * self.vae.config.scaling_factor

    def _on_latents(self, certain: np.ndarray) -> Any:
        """Return a mask (1, 1, h', w') of latents whose pixels are all certain."""
        import torch

        factor = self._factor
        padded = np.pad(certain, self._padding(certain.shape), mode="edge")
        height, width = padded.shape
        cells = padded.reshape(1, 1, height // factor, factor, width // factor, factor)
        whole = np.asarray(cells.all(axis=(3, 5)))
        return torch.from_numpy(whole).to(self.device, self.vae.dtype)

    def _padding(self, size: tuple[int, ...]) -> list[tuple[int, int]]:
        return [(0, -side % self._factor) for side in size]

    @property
    def _factor(self) -> int:
        """Width of the square of pixels that one latent represents."""
        return int(2 ** (len(self.vae.config.block_out_channels) - 1))


class _Schedule:
    """Adapter of a scheduler of diffusers (see ``blend``)."""

    def __init__(self, scheduler: Any, steps: int, device: str) -> None:
        scheduler.set_timesteps(steps, device=device)
        self._scheduler, self.times = scheduler, list(scheduler.timesteps)

    def step(self, latent: Any, predicted: Any, time: Any) -> Any:
        return self._scheduler.step(predicted, time, latent, return_dict=False)[0]

    def noised(self, clean: Any, noise: Any, time: Any) -> Any:
        return self._scheduler.add_noise(clean, noise, time[None])

"""The faults that are planted: what the sources say, and what they would say wrongly."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Fault:
    """A mistake as one makes it.

    Attributes:
        name: a few words.
        kind: sign, transpose, off by one, dropped weight, wrong axis, ...
        file: of the sources.
        right: text that stands there once.
        wrong: text in its place.
        tests: files of tests nearest to it, which are run first.
    """

    name: str
    kind: str
    file: str
    right: str
    wrong: str
    tests: tuple[str, ...]


FAULTS = (
    Fault(
        "light mirrored left to right", "sign", "svu_mi/light/sampling.py",
        "np.stack([sin * np.sin(phi), y, -sin * np.cos(phi)], axis=-1)",
        "np.stack([-sin * np.sin(phi), y, -sin * np.cos(phi)], axis=-1)",
        ("test_environment.py",),
    ),
    Fault(
        "light looked up in the world's frame", "transpose", "svu_mi/light/sampling.py",
        "local.reshape(-1, 3) @ to_world.T", "local.reshape(-1, 3) @ to_world",
        ("test_environment.py",),
    ),
    Fault(
        "columns of the light half a texel aside", "off by one", "svu_mi/light/sampling.py",
        "phi = 2 * np.pi * (np.arange(columns) + 0.5) / columns",
        "phi = 2 * np.pi * np.arange(columns) / columns",
        ("test_environment.py",),
    ),
    Fault(
        "light looked up upside down", "sign", "svu_mi/light/environment.py",
        "return u - dr.floor(dr.detach(u)), dr.acos(dr.clip(local.y, -1, 1)) * dr.inv_pi",
        "return u - dr.floor(dr.detach(u)), dr.acos(dr.clip(-local.y, -1, 1)) * dr.inv_pi",
        ("test_levels.py",),
    ),
    Fault(
        "pixels taken at their corners", "off by one", "svu_mi/visibility/pixels.py",
        "x = dr.dot(camera.x, point) * scale - 0.5", "x = dr.dot(camera.x, point) * scale",
        ("test_observe.py", "test_views.py"),
    ),
    Fault(
        "bilinear weights exchanged", "transpose", "svu_mi/visibility/pixels.py",
        "[(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]",
        "[(1 - fx) * (1 - fy), (1 - fx) * fy, fx * (1 - fy), fx * fy]",
        ("test_observe.py", "test_views.py"),
    ),
    Fault(
        "visibility bit of the neighbour", "off by one", "svu_mi/visibility/bits.py",
        "return ((word >> (number % WORD)) & 1) != 0",
        "return ((word >> ((number + 1) % WORD)) & 1) != 0",
        ("test_bits.py",),
    ),
    Fault(
        "texels upside down", "wrong axis", "svu_mi/surface/raster.py",
        "texel = mi.UInt32(y) * width + mi.UInt32(x)",
        "texel = (height - 1 - mi.UInt32(y)) * width + mi.UInt32(x)",
        ("test_texels.py",),
    ),
    Fault(
        "power as a mean over orders", "dropped weight", "svu_mi/frequency/spectrum.py",
        "spectrum.append([sum(dr.square(c) for c in channel) for channel in channels])",
        "spectrum.append([sum(dr.square(c) for c in channel) / (2 * l + 1) "
        "for channel in channels])",
        ("test_spectrum.py", "test_paper.py"),
    ),
    Fault(
        "ridge of one degree for all", "dropped weight", "svu_mi/frequency/harmonics.py",
        "[math.exp(l) if l or penalize_constant else 0.0 for l in range(degree + 1)]",
        "[1.0 if l or penalize_constant else 0.0 for l in range(degree + 1)]",
        ("test_fit.py", "test_paper.py"),
    ),
    Fault(
        "Fresnel of a dielectric added to metals", "sign", "svu_mi/reflection/principled.py",
        "return e, p, q - d, d - observed", "return e, p, q + d, d - observed",
        ("test_statistics.py",),
    ),
    Fault(
        "lobes as wide as their roughness", "dropped weight", "svu_mi/reflection/principled.py",
        "return roughness * roughness", "return roughness",
        ("test_brdf.py", "test_lobes.py"),
    ),
    Fault(
        "samples count alike, bright or not", "dropped weight", "svu_mi/statistics/sums.py",
        "return 1 / (1 + relative * relative + edges * (contrast / kappa / kappa))",
        "return 1 / (1 + 0 * relative + edges * (contrast / kappa / kappa))",
        ("test_statistics.py", "test_calibrated.py"),
    ),
    Fault(
        "factor of the transposed sums", "transpose", "svu_mi/statistics/factors.py",
        "left[k, j] = left[k, j] - U[i, k] * U[i, j]",
        "left[k, j] = left[k, j] - U[i, k] * U[i, k]",
        ("test_statistics.py",),
    ),
    Fault(
        "shortest interval one part too narrow", "off by one", "svu_mi/posterior/intervals.py",
        "lambda first, end, *_: (first < number) & (end <= number)",
        "lambda first, end, *_: (first < number) & (end < number)",
        ("test_posterior.py", "test_calibrated.py"),
    ),
    Fault(
        "total variation without the lower neighbour", "wrong axis",
        "svu_mi/regularization/tv.py",
        "over_neighbors(around, add,", "over_neighbors(around[:2], add,",
        ("test_regularization.py",),
    ),
    Fault(
        "smoothing that pulls neighbours apart", "sign", "svu_mi/recovery/sh/smoothing.py",
        "x - m, self.strength * slope", "x - m, -self.strength * slope",
        ("test_smoothing.py",),
    ),
    Fault(
        "every level of roughness shows what the first does", "wrong axis",
        "svu_mi/guidance/responses.py",
        "place = self._slot(view) * self.groups + group", "place = self._slot(view) * self.groups",
        ("test_guidance.py",),
    ),
    Fault(
        "the view of least gain first", "sign", "svu_mi/guidance/greedy.py",
        "change = np.where(self._sees[candidates], self.entropy - self._expected[candidates], 0)",
        "change = np.where(self._sees[candidates], self._expected[candidates] - self.entropy, 0)",
        ("test_guidance.py",),
    ),
    Fault(
        "bounds of gains stay as they are", "dropped weight", "svu_mi/guidance/greedy.py",
        "self._bounds[touched] += GROWTH * np.abs(self._bounds[touched])", "pass",
        ("test_guidance.py",),
    ),
    Fault(
        "groups of texels get means instead of sums", "dropped weight",
        "svu_mi/recovery/field/nested.py",
        "sums(right, self.owner)", "sums(right, self.owner) / 4", ("test_field.py",),
    ),
    Fault(
        "Blender's cameras look backwards", "sign", "svu_mi/formats/source.py",
        "OPENGL = np.diag([-1.0, 1.0, -1.0, 1.0])", "OPENGL = np.diag([-1.0, 1.0, 1.0, 1.0])",
        ("test_formats_transforms.py",),
    ),
    Fault(
        "COLMAP's rotations inverted", "transpose", "svu_mi/formats/colmap/source.py",
        "affine(rotation.T, -rotation.T @ view.translation)",
        "affine(rotation, -rotation @ view.translation)",
        ("test_formats_colmap.py",),
    ),
    Fault(
        "principal point on the wrong side", "sign", "svu_mi/formats/source.py",
        "[0.5 - self.center[k] / self.size[k] for k in (0, 1)]",
        "[self.center[k] / self.size[k] - 0.5 for k in (0, 1)]",
        ("test_formats_transforms.py", "test_formats_files.py"),
    ),
    Fault(
        "exported UVs upside down", "wrong axis", "svu_mi/export/mesh.py",
        "return flipped_v(mesh.uvs)", "return mesh.uvs",
        ("test_export.py",),
    ),
    Fault(
        "a file replaced before it is whole", "files", "svu_mi/files.py",
        "temporary.open(\"xb\").close()\n        yield temporary",
        "temporary.open(\"xb\").close()\n        yield path",
        ("test_output.py",),
    ),
    Fault(
        "metallic and roughness exchanged in glTF", "wrong axis", "svu_mi/export/images.py",
        "np.concatenate([np.ones_like(rough), rough, metal], axis=-1)",
        "np.concatenate([np.ones_like(rough), metal, rough], axis=-1)",
        ("test_export.py",),
    ),
    Fault(
        "a journal of a stopped run taken on trust", "files", "svu_mi/results/settling.py",
        "if all(is_inside(name) for names in lists for name in names):", "if lists:",
        ("trust/test_trust_results.py",),
    ),
)  # fmt: skip

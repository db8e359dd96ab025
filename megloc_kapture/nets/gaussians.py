"""A radiance field of Gaussians that are seen along rays, with NeRF-W's two embeddings.

3D Gaussian splatting (Kerbl et al., SIGGRAPH 2023), each Gaussian weighed where it is densest along
a ray instead of projected (as 3DGUT, Wu et al., CVPR 2025, does): so any ray of any camera can be
rendered and trained on. Its light is linear in the appearance embedding; what is transient is a
layer in front of all, a function of image and direction (as the visibility map of Ha-NeRF, Chen et
al., CVPR 2022). On a GPU gsplat, where it is installed, renders whole views.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import nn

from megloc_kapture.nets.radiance import Rays, Rendered, Samples, composite, frequencies

DEFAULT_COUNT = 8192
_APPEARANCE, _TRANSIENT, _HIDDEN = 8, 16, 64
_DIRECTION_FREQUENCIES = 4
# of a ray: a Gaussian that stops less light is not there, one stops no more than
_LEAST, _MOST = 1 / 255, 0.999
_DEPTH_OF_RAY = 48  # Gaussians of a ray that are rendered, the nearest
# rays times Gaussians that are compared at once: on a GPU, and where it has to stay in the cache
_TABLE, _TABLE_OF_CACHE = 1 << 26, 1 << 18
_MIN_SCALE = 1e-3  # in the field's unit: below, tables in float32 would miss them
_EPSILON = 1e-10


class Gaussians(nn.Module):
    """Gaussians, which lie nowhere until :meth:`place`, and the embeddings of the images.

    ``num_images`` and ``num_lights`` are as of :class:`~megloc_kapture.nets.radiance.NerfW`.
    """

    def __init__(
        self, num_images: int, num_lights: int | None = None, *, count: int = DEFAULT_COUNT
    ) -> None:
        super().__init__()
        self.means = nn.Parameter(torch.zeros(count, 3))
        self.log_scales = nn.Parameter(torch.zeros(count, 3))
        self.quats_wxyz = nn.Parameter(torch.tensor([1.0, 0, 0, 0]).repeat(count, 1))
        self.opacity_logits = nn.Parameter(torch.full((count,), 1.0))
        self.colour_logits = nn.Parameter(torch.zeros(count, 3))
        self.light = nn.Parameter(torch.zeros(count, 3, _APPEARANCE))
        self.appearance = nn.Embedding(num_lights or num_images, _APPEARANCE)
        self.transient = nn.Embedding(num_images, _TRANSIENT)
        nn.init.normal_(self.appearance.weight)
        nn.init.normal_(self.transient.weight, std=0.1)
        entering = 3 + 6 * _DIRECTION_FREQUENCIES + _TRANSIENT
        self.moving = nn.Sequential(
            nn.Linear(entering, _HIDDEN),
            nn.ReLU(),
            nn.Linear(_HIDDEN, _HIDDEN),
            nn.ReLU(),
            nn.Linear(_HIDDEN, 5),
        )

    @torch.no_grad()
    def place(self, points: NDArray[np.float32], rgb: NDArray[np.float32]) -> None:
        """Put the Gaussians at points (K, 3) of the field, of colours (K, 3) in 0 to 1.

        They are balls as large as the mean distance to the three nearest others.
        """
        distances, _ = cKDTree(points).query(points, k=4)
        sizes = np.maximum(distances[:, 1:].mean(1), _MIN_SCALE).astype(np.float32)
        self.means.copy_(torch.from_numpy(points))
        self.log_scales.copy_(torch.from_numpy(np.log(sizes))[:, None].expand(-1, 3))
        self.colour_logits.copy_(torch.logit(torch.from_numpy(rgb), eps=0.02))

    def colours(self, appearance: torch.Tensor, which: torch.Tensor | None = None) -> torch.Tensor:
        """Colours (..., 3) in 0 to 1 of Gaussians ``which`` (...) under embeddings (..., A)."""
        rows = slice(None) if which is None else which
        logits, light = self.colour_logits[rows], self.light[rows]
        return torch.sigmoid(logits + (light * appearance[..., None, :]).sum(-1))

    def render(self, rays: Rays, generator: torch.Generator | None = None) -> Rendered:
        """Render rays as the other fields do; nothing is drawn."""
        with torch.autocast(rays.origins.device.type, enabled=False):
            return self._render(rays)

    def _render(self, rays: Rays) -> Rendered:
        whitening = self._whitening()
        which, there = self._along(rays, whitening)
        whitening = whitening[which]
        offset = rays.origins[:, None] - self.means[which]
        origin = (whitening @ offset[..., None])[..., 0]
        ahead = (whitening @ rays.directions[:, None, :, None])[..., 0]
        length = (ahead * ahead).sum(-1).clamp_min(_EPSILON)
        along = (origin * ahead).sum(-1)
        t = -along / length
        distance = (origin * origin).sum(-1) - along * along / length
        alpha = torch.sigmoid(self.opacity_logits)[which] * torch.exp(-0.5 * distance)
        alpha = torch.where(there, alpha.clamp(max=_MOST), 0.0)
        rgb = self.colours(rays.light(self.appearance)[:, None], which)
        # as pieces of a ray that stop so much of it
        static = composite(t, torch.ones_like(t), Samples(-torch.log1p(-alpha), rgb))
        if rays.transient is None:
            return static
        unit = nn.functional.normalize(rays.directions, dim=1)
        entering = torch.cat([frequencies(unit, _DIRECTION_FREQUENCIES), rays.transient], dim=1)
        moving = self.moving(entering)
        hidden = torch.sigmoid(moving[:, 0] - 3.0)
        return replace(
            static,
            rgb=torch.lerp(static.rgb, torch.sigmoid(moving[:, 1:4]), hidden[:, None]),
            beta=static.beta + hidden * nn.functional.softplus(moving[:, 4] - 1.0),
            transient_density=hidden.mean(),
        )

    def rasterize(
        self,
        cam_from_field: torch.Tensor,
        calibration: torch.Tensor,
        size_px: tuple[int, int],
        appearance: torch.Tensor | None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Render a pinhole view by gsplat, which needs a GPU.

        Returns colours (H, W, 3) in 0 to 1, depths (H, W) along the optical axis in the field's
        unit, and opacities (H, W).

        Parameters
        ----------
        cam_from_field, calibration : a rigid transform (4, 4), and K (3, 3).
        size_px : width and height.
        appearance : embedding (A,); the mean of all unless given.
        """
        from gsplat import rasterization

        if appearance is None:
            appearance = self.appearance.weight.mean(0)
        found, opacity, _ = rasterization(
            self.means,
            nn.functional.normalize(self.quats_wxyz, dim=1),
            self._scales(),
            torch.sigmoid(self.opacity_logits),
            self.colours(appearance),
            cam_from_field[None],
            calibration[None],
            *size_px,
            render_mode="RGB+ED",
            packed=False,
            with_ut=True,
            with_eval3d=True,
        )
        return found[0, ..., :3], found[0, ..., 3], opacity[0, ..., 0]

    def _scales(self) -> torch.Tensor:
        """Standard deviations (K, 3) along the axes."""
        return torch.exp(self.log_scales).clamp_min(_MIN_SCALE)

    def _whitening(self) -> torch.Tensor:
        """Matrices (K, 3, 3) that turn each Gaussian into the unit ball."""
        w, x, y, z = nn.functional.normalize(self.quats_wxyz, dim=1).unbind(1)
        rows = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        rotation = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
        return rotation.transpose(1, 2) / self._scales()[..., None]

    @torch.no_grad()
    def _along(self, rays: Rays, whitening: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gaussians (N, S) that each ray meets, the nearest first, and which of them there are.

        Distances and places of all Gaussians along all rays are products of two tables, for they
        are quadratic in the ray and in the Gaussian.
        """
        precision = whitening.transpose(1, 2) @ whitening
        pull = (precision @ self.means[..., None])[..., 0]
        upper = torch.triu_indices(3, 3, device=precision.device)
        packed = precision[:, upper[0], upper[1]].T
        of_along = torch.cat([packed, -pull.T])
        of_far_off = torch.cat([packed, -2 * pull.T, (pull * self.means).sum(1)[None]])
        reach = 2 * torch.log(torch.sigmoid(self.opacity_logits) / _LEAST)
        table = _TABLE if self.means.is_cuda else _TABLE_OF_CACHE
        step, parts = max(1, table // len(self.means)), []
        for start in range(0, len(rays.origins), step):
            o, d = rays.origins[start : start + step], rays.directions[start : start + step]
            lengths = _squares(d, d, upper) @ packed
            along = torch.cat([_squares(o, d, upper), d], dim=1) @ of_along
            far_off = torch.cat([_squares(o, o, upper), o, o.new_ones(len(o), 1)], 1) @ of_far_off
            t = lengths.reciprocal_().mul_(along).neg_()
            met = (far_off.addcmul_(along, t) < reach) & (t > rays.near) & (t < rays.far)
            ray, gaussian = torch.nonzero(met, as_tuple=True)
            parts.append((ray + start, gaussian, t[ray, gaussian]))
        ray, gaussian, t = (torch.cat(each) for each in zip(*parts, strict=True))
        order = torch.argsort(t, stable=True)
        order = order[torch.argsort(ray[order], stable=True)]
        ray, gaussian = ray[order], gaussian[order]
        counts = torch.bincount(ray, minlength=len(rays.origins))
        place = torch.arange(len(ray), device=ray.device) - (torch.cumsum(counts, 0) - counts)[ray]
        kept = place < _DEPTH_OF_RAY
        which = ray.new_zeros(len(rays.origins), _DEPTH_OF_RAY)
        there = torch.zeros_like(which, dtype=torch.bool)
        which[ray[kept], place[kept]] = gaussian[kept]
        there[ray[kept], place[kept]] = True
        return which, there


def _squares(a: torch.Tensor, b: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Products (N, 6) whose sum with a symmetric matrix' upper triangle is ``a M b``."""
    both = a[:, upper[0]] * b[:, upper[1]] + a[:, upper[1]] * b[:, upper[0]]
    return torch.where(upper[0] == upper[1], 0.5 * both, both)

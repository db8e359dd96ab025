"""A radiance field of tri-planes that trains on a processor: small, with NeRF-W's two embeddings.

Features of a point are products of what three planes say (K-Planes, Fridovich-Keil et al., CVPR
2023, eq. 1) at three resolutions; two small networks turn them into density and colour, a third
into what is transient. Samples lie about the known depth where there is one, else where a first
pass through the density alone finds something.
"""

from __future__ import annotations

import torch
from torch import nn

from megloc_kapture.nets.radiance import (
    Rays,
    Rendered,
    Samples,
    about_depth,
    composite,
    frequencies,
    importance,
    spacings,
    stratified,
)

_RESOLUTIONS = (64, 128, 256)
_CHANNELS = 12
_GEOMETRY, _HIDDEN = 15, 64
_APPEARANCE, _TRANSIENT = 8, 16
_DIRECTION_FREQUENCIES, _POINT_FREQUENCIES = 2, 3
# samples of a ray: to look where something is, in training and in rendering, where coarse ones
# miss what training has made thin; then spread evenly, then where it is
_LOOKING, _CLOSELY, _SPREAD, _THERE = 32, 96, 8, 16
_REACH = 1.25  # beyond 1 space is contracted, to this at infinity
_MAX_LOG_DENSITY = 12.0
_AXES = ((0, 1), (0, 2), (1, 2))


class TriPlane(nn.Module):
    """Three planes at three resolutions, and the embeddings of the images.

    Space from -1 to 1 is as it is, what lies beyond is contracted.

    Parameters
    ----------
    num_images, num_lights : rows of the transient and of the appearance embedding; as many of the
        second as of the first unless given.
    unconstrained : the images differ in light and show what moves; without, one appearance and
        nothing transient.
    """

    def __init__(
        self, num_images: int, num_lights: int | None = None, *, unconstrained: bool = True
    ) -> None:
        super().__init__()
        self.planes = nn.ParameterList(
            nn.Parameter(torch.empty(3, _CHANNELS, size, size).uniform_(0.1, 0.5))
            for size in _RESOLUTIONS
        )
        self.geometry = _mlp(_CHANNELS * len(_RESOLUTIONS), 1 + _GEOMETRY)
        appearance, transient = (_APPEARANCE, _TRANSIENT) if unconstrained else (0, 0)
        seen = _GEOMETRY + 3 + 6 * _DIRECTION_FREQUENCIES + appearance
        self.colour = _mlp(seen, 3)
        self.appearance: nn.Embedding | None = None
        self.transient: nn.Embedding | None = None
        if unconstrained:
            self.appearance = nn.Embedding(num_lights or num_images, appearance)
            self.transient = nn.Embedding(num_images, transient)
            for embedding in (self.appearance, self.transient):
                nn.init.normal_(embedding.weight, std=0.1)
            self.moving = _mlp(3 + 6 * _POINT_FREQUENCIES + transient, 5)

    def density(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Density (N, S) at points (N, S, 3), and features (N, S, 15) of what is there."""
        inside = _contracted(points).reshape(-1, 3) / _REACH
        grid = torch.stack([inside[:, axes] for axes in _AXES])[:, :, None]
        features = [
            nn.functional.grid_sample(plane, grid, align_corners=True, padding_mode="border")
            .squeeze(-1)
            .prod(0)
            for plane in self.planes
        ]
        found = self.geometry(torch.cat(features).T).reshape(*points.shape[:2], -1)
        return torch.exp(found[..., 0].clamp(max=_MAX_LOG_DENSITY)), found[..., 1:]

    def render(self, rays: Rays, generator: torch.Generator | None = None) -> Rendered:
        """See :class:`~megloc_kapture.nets.radiance.RadianceField`."""
        t = self._where(rays, generator)
        count = t.shape[1]
        points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
        deltas = spacings(t, rays)
        sigma, features = self.density(points)
        unit = nn.functional.normalize(rays.directions, dim=1)
        beside = [frequencies(unit, _DIRECTION_FREQUENCIES)]
        if self.appearance is not None:
            appearance = rays.appearance
            if appearance is None:
                appearance = self.appearance.weight.mean(0).expand(len(t), -1)
            beside.append(appearance)
        seen = torch.cat([features, _repeated(torch.cat(beside, dim=1), count)], dim=-1)
        rgb = torch.sigmoid(self.colour(seen))
        if self.transient is None or rays.transient is None:
            return composite(t, deltas, Samples(sigma, rgb))
        entering = frequencies(_contracted(points), _POINT_FREQUENCIES)
        moving = self.moving(torch.cat([entering, _repeated(rays.transient, count)], dim=-1))
        softplus = nn.functional.softplus
        samples = Samples(
            sigma,
            rgb,
            softplus(moving[..., 0] - 3.0),
            torch.sigmoid(moving[..., 1:4]),
            softplus(moving[..., 4] - 1.0),
        )
        return composite(t, deltas, samples)

    @torch.no_grad()
    def _where(self, rays: Rays, generator: torch.Generator | None) -> torch.Tensor:
        """Samples (N, S) of rays, ascending."""
        depth = rays.depth
        spread = stratified(rays, _SPREAD, generator)
        there = spread.new_zeros(len(spread), _THERE)
        unknown = torch.arange(len(spread), device=spread.device)
        if depth is not None:
            there = about_depth(depth, there, generator)
            unknown = torch.nonzero(depth <= 0)[:, 0]
        if len(unknown):
            some = Rays(rays.origins[unknown], rays.directions[unknown], rays.near, rays.far)
            t = stratified(some, _LOOKING if generator else _CLOSELY, generator)
            points = some.origins[:, None] + t[..., None] * some.directions[:, None]
            sigma = self.density(points)[0]
            passed = torch.cumsum(sigma * spacings(t, some), dim=1)
            left = torch.exp(-torch.cat([torch.zeros_like(passed[:, :1]), passed], dim=1))
            there[unknown] = importance(t, left[:, :-1] - left[:, 1:], _THERE, generator)
        return torch.sort(torch.cat([spread, there], dim=1), dim=1).values


def _mlp(entering: int, leaving: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(entering, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, leaving))


def _repeated(values: torch.Tensor, count: int) -> torch.Tensor:
    return values[:, None].expand(-1, count, -1)


def _contracted(points: torch.Tensor) -> torch.Tensor:
    """Each coordinate beyond 1 brought below the reach, smoothly (as mip-NeRF 360, eq. 10)."""
    size = points.abs()
    margin = _REACH - 1.0
    outside = _REACH - margin**2 / (size.clamp_min(1.0) - 1.0 + margin)
    return torch.where(size <= 1.0, points, torch.sign(points) * outside)

"""NeRF-W (Martin-Brualla et al., CVPR 2021), with the tensor names of kwea123/nerf_pl's ``nerfw``.

A checkpoint of that branch has ``nerf_coarse.*``, ``nerf_fine.*``, ``embedding_a.weight`` and
``embedding_t.weight``. As there, appearance and what is transient are of the fine network alone.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import nn

from megloc_kapture.nets.radiance import (
    Rays,
    Rendered,
    Samples,
    composite,
    frequencies,
    importance,
    spacings,
    stratified,
)

_LAYERS, _WIDTH, _SKIP = 8, 256, 4
_XYZ_FREQUENCIES, _DIRECTION_FREQUENCIES = 10, 4
_APPEARANCE, _TRANSIENT = 48, 16
_COARSE, _FINE = 64, 64


class NerfMlp(nn.Module):
    """One of the two networks: eight layers of 256, the heads for colour and for what is transient.

    Parameters
    ----------
    appearance_size, transient_size : of the embeddings; 0: not conditioned, no transient head.
    """

    def __init__(self, appearance_size: int = 0, transient_size: int = 0) -> None:
        super().__init__()
        xyz = 3 + 6 * _XYZ_FREQUENCIES
        for layer in range(_LAYERS):
            entering = {0: xyz, _SKIP: _WIDTH + xyz}.get(layer, _WIDTH)
            block = nn.Sequential(nn.Linear(entering, _WIDTH), nn.ReLU())
            setattr(self, f"xyz_encoding_{layer + 1}", block)
        half = _WIDTH // 2
        self.xyz_encoding_final = nn.Linear(_WIDTH, _WIDTH)
        entering = _WIDTH + 3 + 6 * _DIRECTION_FREQUENCIES + appearance_size
        self.dir_encoding = nn.Sequential(nn.Linear(entering, half), nn.ReLU())
        self.static_sigma = nn.Sequential(nn.Linear(_WIDTH, 1), nn.Softplus())
        self.static_rgb = nn.Sequential(nn.Linear(half, 3), nn.Sigmoid())
        if transient_size:
            layers: list[nn.Module] = []
            for entering in (_WIDTH + transient_size, half, half, half):
                layers += [nn.Linear(entering, half), nn.ReLU()]
            self.transient_encoding = nn.Sequential(*layers)
            self.transient_sigma = nn.Sequential(nn.Linear(half, 1), nn.Softplus())
            self.transient_rgb = nn.Sequential(nn.Linear(half, 3), nn.Sigmoid())
            self.transient_beta = nn.Sequential(nn.Linear(half, 1), nn.Softplus())

    def forward(
        self,
        points: torch.Tensor,
        directions: torch.Tensor,
        appearance: torch.Tensor | None = None,
        transient: torch.Tensor | None = None,
    ) -> Samples:
        """Samples at points (N, S, 3), seen along unit directions (N, 3)."""
        count = points.shape[1]

        def repeated(values: torch.Tensor) -> torch.Tensor:
            return values[:, None].expand(-1, count, -1)

        xyz = frequencies(points, _XYZ_FREQUENCIES)
        hidden = xyz
        for layer in range(_LAYERS):
            if layer == _SKIP:
                hidden = torch.cat([xyz, hidden], dim=-1)
            hidden = getattr(self, f"xyz_encoding_{layer + 1}")(hidden)
        sigma = self.static_sigma(hidden)[..., 0]
        final = self.xyz_encoding_final(hidden)
        beside = [repeated(frequencies(directions, _DIRECTION_FREQUENCIES))]
        if appearance is not None:
            beside.append(repeated(appearance))
        rgb = self.static_rgb(self.dir_encoding(torch.cat([final, *beside], dim=-1)))
        if transient is None:
            return Samples(sigma, rgb)
        moving = self.transient_encoding(torch.cat([final, repeated(transient)], dim=-1))
        return Samples(
            sigma,
            rgb,
            self.transient_sigma(moving)[..., 0],
            self.transient_rgb(moving),
            self.transient_beta(moving)[..., 0],
        )


class NerfW(nn.Module):
    """The coarse and the fine network, and the embeddings of the images.

    Parameters
    ----------
    num_images, num_lights : rows of the transient and of the appearance embedding; as many of the
        second as of the first unless given.
    """

    def __init__(self, num_images: int, num_lights: int | None = None) -> None:
        super().__init__()
        self.nerf_coarse = NerfMlp()
        self.nerf_fine = NerfMlp(_APPEARANCE, _TRANSIENT)
        self.embedding_a = nn.Embedding(num_lights or num_images, _APPEARANCE)
        self.embedding_t = nn.Embedding(num_images, _TRANSIENT)

    @property
    def appearance(self) -> nn.Embedding:
        """The embeddings of light and exposure."""
        return self.embedding_a

    @property
    def transient(self) -> nn.Embedding:
        """The embeddings of what is in one image only."""
        return self.embedding_t

    def render(self, rays: Rays, generator: torch.Generator | None = None) -> Rendered:
        """See :class:`~megloc_kapture.nets.radiance.RadianceField`."""
        unit = nn.functional.normalize(rays.directions, dim=1)
        t = stratified(rays, _COARSE, generator)
        coarse = composite(t, spacings(t, rays), self.nerf_coarse(_points(rays, t), unit))
        more = importance(t, coarse.weights, _FINE, generator)
        t = torch.sort(torch.cat([t, more], dim=1), dim=1).values
        appearance = rays.appearance
        if appearance is None:
            appearance = self.embedding_a.weight.mean(0).expand(len(t), -1)
        samples = self.nerf_fine(_points(rays, t), unit, appearance, rays.transient)
        return replace(composite(t, spacings(t, rays), samples), coarse_rgb=coarse.rgb)


def _points(rays: Rays, t: torch.Tensor) -> torch.Tensor:
    return rays.origins[:, None] + t[..., None] * rays.directions[:, None]

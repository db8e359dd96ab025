"""Radiance fields: rays in; colour, depth, opacity and uncertainty out.

Volume rendering as in NeRF (Mildenhall et al., ECCV 2020, eq. 3), with the transient part and the
loss of NeRF-W (Martin-Brualla et al., CVPR 2021, eqs. 8 to 13). Rays are ``origin + t direction``;
where directions have z = 1 in their camera, t is depth along its optical axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import nn

_DEPTH_SPREAD = 0.03  # of samples about a known depth, share of it
_EPSILON = 1e-10
_BETA_MIN = 0.03  # uncertainty of a ray that meets nothing transient


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of one or several images.

    Attributes
    ----------
    origins, directions : float32 (N, 3), in the field's own units.
    near, far : t at which a ray begins and ends; in the unit of the directions' z.
    appearance, transient : embeddings (N, A) and (N, T) of the images that the rays are of; None:
        the field's mean appearance, and nothing transient.
    depth : float32 (N,), t at which the surface is known to be, 0 where it is not; samples are
        taken about it.
    """

    origins: torch.Tensor
    directions: torch.Tensor
    near: float
    far: float
    appearance: torch.Tensor | None = None
    transient: torch.Tensor | None = None
    depth: torch.Tensor | None = None


@dataclass(frozen=True, eq=False)
class Samples:
    """What a field says at S samples of each ray.

    Attributes
    ----------
    sigma, rgb : (N, S) density of the static part, and its colour (N, S, 3) in 0 to 1.
    transient_sigma, transient_rgb, transient_beta : the same of the transient part, and its
        uncertainty (N, S); None where it is off.
    """

    sigma: torch.Tensor
    rgb: torch.Tensor
    transient_sigma: torch.Tensor | None = None
    transient_rgb: torch.Tensor | None = None
    transient_beta: torch.Tensor | None = None


@dataclass(frozen=True, eq=False)
class Rendered:
    """Rays as a field renders them.

    Attributes
    ----------
    rgb : (N, 3) in 0 to 1; black where nothing is.
    depth : (N,), mean t of what is seen; 0 where nothing is.
    opacity : (N,), share of the light that the field stops.
    beta : (N,), standard deviation of the colour by NeRF-W's transient part; the least one without.
    weights : (N, S), share of each sample.
    transient_density : mean over all samples; 0 without.
    coarse_rgb : of a field's coarse network, or None.
    """

    rgb: torch.Tensor
    depth: torch.Tensor
    opacity: torch.Tensor
    beta: torch.Tensor
    weights: torch.Tensor
    transient_density: torch.Tensor
    coarse_rgb: torch.Tensor | None = None


class RadianceField(Protocol):
    """What trains and renders: a torch module of its images' embeddings."""

    appearance: nn.Embedding | None
    transient: nn.Embedding | None

    def render(self, rays: Rays, generator: torch.Generator | None = None) -> Rendered:
        """Render rays; samples are drawn by the generator, evenly spaced without one."""
        ...


def composite(t: torch.Tensor, deltas: torch.Tensor, samples: Samples) -> Rendered:
    """Composite samples along rays: NeRF's eq. 3, with a transient part NeRF-W's eqs. 8 to 10.

    Parameters
    ----------
    t : (N, S), where the samples are, ascending.
    deltas : (N, S), length of the piece of the ray that each stands for, in the unit of 1/density.
    """
    total = samples.sigma
    if samples.transient_sigma is not None:
        total = total + samples.transient_sigma
    passed = torch.cumsum(total * deltas, dim=1)
    transmitted = torch.exp(-torch.cat([torch.zeros_like(passed[:, :1]), passed[:, :-1]], dim=1))
    static = transmitted * -torch.expm1(-samples.sigma * deltas)
    weights = transmitted * -torch.expm1(-total * deltas)
    rgb = (static[..., None] * samples.rgb).sum(1)
    beta = torch.full_like(t[:, 0], _BETA_MIN)
    density = t.new_zeros(())
    if samples.transient_sigma is not None:
        assert samples.transient_rgb is not None and samples.transient_beta is not None
        moving = transmitted * -torch.expm1(-samples.transient_sigma * deltas)
        rgb = rgb + (moving[..., None] * samples.transient_rgb).sum(1)
        beta = beta + (moving * samples.transient_beta).sum(1)
        density = samples.transient_sigma.mean()
    opacity = weights.sum(1)
    depth = (weights * t).sum(1) / opacity.clamp_min(_EPSILON)
    return Rendered(rgb, depth, opacity, beta, weights, density)


def spacings(t: torch.Tensor, rays: Rays) -> torch.Tensor:
    """Lengths (N, S) of the pieces between samples, the last one up to the ray's end."""
    ends = torch.full_like(t[:, :1], rays.far)
    steps = torch.diff(torch.cat([t, ends], dim=1), dim=1).clamp_min(0)
    return steps * torch.linalg.vector_norm(rays.directions, dim=1, keepdim=True)


def stratified(rays: Rays, count: int, generator: torch.Generator | None) -> torch.Tensor:
    """Samples (N, count), one in each of ``count`` pieces of a ray, which grow with t."""
    number = len(rays.origins)
    shares = torch.arange(count, device=rays.origins.device, dtype=rays.origins.dtype)
    within = _uniform((number, count), generator, rays.origins)
    ratio = torch.log(rays.origins.new_tensor(rays.far / rays.near))
    return rays.near * torch.exp((shares + within) / count * ratio)


def importance(
    t: torch.Tensor, weights: torch.Tensor, count: int, generator: torch.Generator | None
) -> torch.Tensor:
    """Samples (N, count) where the weights (N, S) of samples at t (N, S) are: NeRF, section 5.2."""
    edges = 0.5 * (t[:, 1:] + t[:, :-1])
    inner = weights[:, 1:-1].detach() + 1e-5
    shares = torch.cumsum(inner / inner.sum(1, keepdim=True), dim=1)
    shares = torch.cat([torch.zeros_like(shares[:, :1]), shares], dim=1)
    drawn = torch.arange(count, device=t.device, dtype=t.dtype)
    drawn = (drawn + _uniform((len(t), count), generator, t)) / count
    above = torch.searchsorted(shares, drawn.contiguous(), right=True).clamp(1, shares.shape[1] - 1)
    low, high = shares.gather(1, above - 1), shares.gather(1, above)
    begin, end = edges.gather(1, above - 1), edges.gather(1, above)
    return begin + (drawn - low) / (high - low).clamp_min(1e-6) * (end - begin)


def about_depth(
    depth: torch.Tensor, instead: torch.Tensor, generator: torch.Generator | None
) -> torch.Tensor:
    """Samples (N, S) about known depths (N,), evenly; ``instead`` (N, S) where there is none."""
    count = instead.shape[1]
    drawn = torch.arange(count, device=depth.device, dtype=depth.dtype)
    drawn = (drawn + _uniform(tuple(instead.shape), generator, depth)) / count
    return torch.where(
        depth[:, None] > 0, depth[:, None] * (1 + _DEPTH_SPREAD * (2 * drawn - 1)), instead
    )


def _uniform(
    shape: tuple[int, ...], generator: torch.Generator | None, like: torch.Tensor
) -> torch.Tensor:
    """Numbers in 0 to 1, drawn on the processor so that a seed is one on every device."""
    if generator is None:
        return torch.full(shape, 0.5, dtype=like.dtype, device=like.device)
    return torch.rand(shape, generator=generator, dtype=like.dtype).to(like.device)


def frequencies(values: torch.Tensor, count: int) -> torch.Tensor:
    """Positional encoding of (..., 3): the values, then sines and cosines of 1, 2, 4, ... times.

    NeRF's eq. 4 in the order of nerf_pl: (..., 3 + 6 count).
    """
    parts = [values]
    for power in range(count):
        parts += [torch.sin(2.0**power * values), torch.cos(2.0**power * values)]
    return torch.cat(parts, dim=-1)


def nerf_w_loss(rendered: Rendered, rgb: torch.Tensor) -> torch.Tensor:
    """NeRF-W's loss (eq. 13) with the public code's constants; rgb (N, 3) is what was seen.

    Half the coarse network's squared error, where there is one; without a transient part beta is
    constant and this is, up to factor and offset, the squared error.
    """
    squared = torch.square(rendered.rgb - rgb).mean(1)
    loss = (squared / (2 * torch.square(rendered.beta))).mean() + torch.log(rendered.beta).mean()
    loss = loss + 3.0 + 0.01 * rendered.transient_density
    if rendered.coarse_rgb is not None:
        loss = loss + 0.5 * torch.square(rendered.coarse_rgb - rgb).mean()
    return loss

"""Radiance fields, which render the colour, depth, opacity and uncertainty of rays.

Volume rendering follows NeRF (Mildenhall et al., ECCV 2020, eq. 3); the transient part and the loss
follow NeRF-W (Martin-Brualla et al., CVPR 2021, eqs. 8 to 13). Rays are ``origin + t direction``;
directions are scaled such that t is the depth along the optical axis in the map's unit.
:class:`NerfW` has the keys of kwea123/nerf_pl's branch ``nerfw``; :class:`TriPlane` is small enough
to train on a CPU.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import nn

_DEPTH_SPREAD = 0.03  # relative spread of the samples around a known depth
_EPSILON = 1e-10
_BETA_MIN = 0.03  # uncertainty of a ray without transient density
# NeRF-W: layers, width, skip connection; frequencies of points and directions; embedding sizes;
# coarse and additional fine samples per ray
_LAYERS, _WIDTH, _SKIP = 8, 256, 4
_NERF_POINT_FREQUENCIES, _NERF_DIRECTION_FREQUENCIES = 10, 4
_NERF_APPEARANCE, _NERF_TRANSIENT = 48, 16
_COARSE, _FINE = 64, 64
# tri-planes: sides and channels of the planes; geometry features and width of the hidden layers;
# frequencies of points and directions; embedding sizes
_RESOLUTIONS, _CHANNELS = (64, 128, 256), 12
_GEOMETRY, _HIDDEN = 15, 64
_POINT_FREQUENCIES, _DIRECTION_FREQUENCIES = 3, 2
_APPEARANCE, _TRANSIENT = 8, 16
# samples per ray: density pass in training and in rendering (more, as trained surfaces are thin),
# whole ray, near the surface
_TRAINING_PASS, _RENDERING_PASS, _WHOLE_RAY, _NEAR_SURFACE = 32, 96, 8, 16
_REACH = 1.25  # bound of the contracted coordinates; coordinates up to 1 are not contracted
_MAX_LOG_DENSITY = 12.0
_AXES = ((0, 1), (0, 2), (1, 2))


@dataclass(frozen=True, eq=False)
class Rays:
    # origins, directions: float32 (N, 3), in the field's frame; a direction is the step for t = 1
    origins: torch.Tensor
    directions: torch.Tensor
    # near, far: t of a ray's ends
    near: float
    far: float
    # appearance, transient: image embeddings (N, A) and (N, T); without them, rays have the mean
    # appearance and no transient part
    appearance: torch.Tensor | None = None
    transient: torch.Tensor | None = None
    # float32 (N,): t of the surface, around which samples are drawn; 0 where unknown
    depth: torch.Tensor | None = None

    def points(self, t: torch.Tensor) -> torch.Tensor:
        return self.origins[:, None] + t[..., None] * self.directions[:, None]

    def light(self, embedding: nn.Embedding) -> torch.Tensor:
        if self.appearance is not None:
            return self.appearance
        return embedding.weight.mean(0).expand(len(self.origins), -1)


@dataclass(frozen=True, eq=False)
class Samples:
    # sigma, rgb: density (N, S) and colour (N, S, 3), in [0, 1], of the static part
    sigma: torch.Tensor
    rgb: torch.Tensor
    # transient_sigma, transient_rgb, transient_beta: density (N, S), colour (N, S, 3) and
    # uncertainty (N, S) of the transient part, or None
    transient_sigma: torch.Tensor | None = None
    transient_rgb: torch.Tensor | None = None
    transient_beta: torch.Tensor | None = None


@dataclass(frozen=True, eq=False)
class Rendered:
    rgb: torch.Tensor  # (N, 3) in [0, 1]; black where empty
    depth: torch.Tensor  # (N,), mean t; 0 where empty
    opacity: torch.Tensor  # (N,), share of the light that the ray's samples absorb
    # (N,), NeRF-W's standard deviation of the colour; its minimum without a transient part
    beta: torch.Tensor
    weights: torch.Tensor  # (N, S), share of the light that each sample absorbs
    transient_density: torch.Tensor  # scalar mean over all samples; 0 without a transient part
    coarse_rgb: torch.Tensor | None = None


def composite(t: torch.Tensor, deltas: torch.Tensor, samples: Samples) -> Rendered:
    """Composite samples along rays: NeRF's eq. 3, or with a transient part NeRF-W's eqs. 8 to 10.

    ``t`` (N, S) is ascending; ``deltas`` (N, S) are the lengths of the ray segments, in the unit of
    1/density.
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
    """Return lengths (N, S) between samples, the last one up to the ray's end."""
    ends = torch.full_like(t[:, :1], rays.far)
    steps = torch.diff(torch.cat([t, ends], dim=1), dim=1).clamp_min(0)
    return steps * torch.linalg.vector_norm(rays.directions, dim=1, keepdim=True)


def stratified(rays: Rays, count: int, generator: torch.Generator | None) -> torch.Tensor:
    """Sample one t in each of ``count`` intervals of a ray, which grow with t: (N, count)."""
    shares = _shares(len(rays.origins), count, generator, rays.origins)
    ratio = torch.log(rays.origins.new_tensor(rays.far / rays.near))
    return rays.near * torch.exp(shares * ratio)


def importance(
    t: torch.Tensor, weights: torch.Tensor, count: int, generator: torch.Generator | None
) -> torch.Tensor:
    """Draw importance samples (N, count) from weights (N, S) at t (N, S): NeRF, section 5.2."""
    edges = 0.5 * (t[:, 1:] + t[:, :-1])
    inner = weights[:, 1:-1].detach() + 1e-5
    shares = torch.cumsum(inner / inner.sum(1, keepdim=True), dim=1)
    shares = torch.cat([torch.zeros_like(shares[:, :1]), shares], dim=1)
    drawn = _shares(len(t), count, generator, t)
    above = torch.searchsorted(shares, drawn.contiguous(), right=True).clamp(1, shares.shape[1] - 1)
    low, high = shares.gather(1, above - 1), shares.gather(1, above)
    begin, end = edges.gather(1, above - 1), edges.gather(1, above)
    return begin + (drawn - low) / (high - low).clamp_min(1e-6) * (end - begin)


def about_depth(
    depth: torch.Tensor, instead: torch.Tensor, generator: torch.Generator | None
) -> torch.Tensor:
    """Return stratified samples (N, S) around depths (N,), and ``instead`` where they are 0."""
    drawn = _shares(len(depth), instead.shape[1], generator, depth)
    return torch.where(
        depth[:, None] > 0, depth[:, None] * (1 + _DEPTH_SPREAD * (2 * drawn - 1)), instead
    )


def _shares(
    rows: int, count: int, generator: torch.Generator | None, like: torch.Tensor
) -> torch.Tensor:
    """Return one position in each of ``count`` equal parts of 0 to 1: (rows, count), ascending."""
    within: torch.Tensor | float = 0.5
    if generator is not None:
        within = torch.rand((rows, count), generator=generator, dtype=like.dtype).to(like.device)
    parts = torch.arange(count, device=like.device, dtype=like.dtype).expand(rows, -1)
    return (parts + within) / count


def frequencies(values: torch.Tensor, count: int) -> torch.Tensor:
    """Apply the positional encoding to values (..., 3): (..., 3 + 6 count).

    It is NeRF's eq. 4 as in nerf_pl: without the factor pi, and preceded by the values.
    """
    parts = [values]
    for power in range(count):
        parts += [torch.sin(2.0**power * values), torch.cos(2.0**power * values)]
    return torch.cat(parts, dim=-1)


def nerf_w_loss(rendered: Rendered, rgb: torch.Tensor) -> torch.Tensor:
    """Compute NeRF-W's loss (eq. 13) for observed colours (N, 3), with nerf_pl's constants."""
    squared = torch.square(rendered.rgb - rgb).mean(1)
    loss = (squared / (2 * torch.square(rendered.beta))).mean() + torch.log(rendered.beta).mean()
    loss = loss + 3.0 + 0.01 * rendered.transient_density
    if rendered.coarse_rgb is not None:
        loss = loss + 0.5 * torch.square(rendered.coarse_rgb - rgb).mean()
    return loss


class NerfMlp(nn.Module):
    """One of NeRF-W's two networks: eight layers, a colour head and an optional transient head."""

    def __init__(self, appearance_size: int = 0, transient_size: int = 0) -> None:
        super().__init__()
        xyz = 3 + 6 * _NERF_POINT_FREQUENCIES
        for layer in range(_LAYERS):
            num_inputs = {0: xyz, _SKIP: _WIDTH + xyz}.get(layer, _WIDTH)
            block = nn.Sequential(nn.Linear(num_inputs, _WIDTH), nn.ReLU())
            setattr(self, f"xyz_encoding_{layer + 1}", block)
        half = _WIDTH // 2
        self.xyz_encoding_final = nn.Linear(_WIDTH, _WIDTH)
        num_inputs = _WIDTH + 3 + 6 * _NERF_DIRECTION_FREQUENCIES + appearance_size
        self.dir_encoding = nn.Sequential(nn.Linear(num_inputs, half), nn.ReLU())
        self.static_sigma = nn.Sequential(nn.Linear(_WIDTH, 1), nn.Softplus())
        self.static_rgb = nn.Sequential(nn.Linear(half, 3), nn.Sigmoid())
        if transient_size:
            layers: list[nn.Module] = []
            for num_inputs in (_WIDTH + transient_size, half, half, half):
                layers += [nn.Linear(num_inputs, half), nn.ReLU()]
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
        """Evaluate points (N, S, 3) with unit view directions (N, 3)."""
        count = points.shape[1]
        xyz = frequencies(points, _NERF_POINT_FREQUENCIES)
        hidden = xyz
        for layer in range(_LAYERS):
            if layer == _SKIP:
                hidden = torch.cat([xyz, hidden], dim=-1)
            hidden = getattr(self, f"xyz_encoding_{layer + 1}")(hidden)
        sigma = self.static_sigma(hidden)[..., 0]
        final = self.xyz_encoding_final(hidden)
        inputs = [final, _repeated(frequencies(directions, _NERF_DIRECTION_FREQUENCIES), count)]
        if appearance is not None:
            inputs.append(_repeated(appearance, count))
        rgb = self.static_rgb(self.dir_encoding(torch.cat(inputs, dim=-1)))
        if transient is None:
            return Samples(sigma, rgb)
        moving = self.transient_encoding(torch.cat([final, _repeated(transient, count)], dim=-1))
        moving_sigma = self.transient_sigma(moving)[..., 0]
        beta = self.transient_beta(moving)[..., 0]
        return Samples(sigma, rgb, moving_sigma, self.transient_rgb(moving), beta)


class NerfW(nn.Module):
    """NeRF-W's coarse and fine network, and the embeddings of the images.

    The keys are nerf_pl's: ``nerf_coarse.*``, ``nerf_fine.*``, ``embedding_a.weight`` and
    ``embedding_t.weight``. Only the fine network depends on appearance and has a transient part.
    ``num_images`` and ``num_lights`` are the numbers of rows of the transient and of the appearance
    embedding.
    """

    def __init__(self, num_images: int, num_lights: int) -> None:
        super().__init__()
        self.nerf_coarse = NerfMlp()
        self.nerf_fine = NerfMlp(_NERF_APPEARANCE, _NERF_TRANSIENT)
        self.embedding_a = nn.Embedding(num_lights, _NERF_APPEARANCE)
        self.embedding_t = nn.Embedding(num_images, _NERF_TRANSIENT)

    @property
    def appearance(self) -> nn.Embedding:
        return self.embedding_a

    @property
    def transient(self) -> nn.Embedding:
        return self.embedding_t

    def render(self, rays: Rays, generator: torch.Generator | None = None) -> Rendered:
        """Render rays; samples are random with a generator, else fixed."""
        unit = nn.functional.normalize(rays.directions, dim=1)
        t = stratified(rays, _COARSE, generator)
        coarse = composite(t, spacings(t, rays), self.nerf_coarse(rays.points(t), unit))
        more = importance(t, coarse.weights, _FINE, generator)
        t = torch.sort(torch.cat([t, more], dim=1), dim=1).values
        light = rays.light(self.embedding_a)
        samples = self.nerf_fine(rays.points(t), unit, light, rays.transient)
        return replace(composite(t, spacings(t, rays), samples), coarse_rgb=coarse.rgb)


class TriPlane(nn.Module):
    """Three planes at each of three resolutions, and the embeddings of the images.

    A point's features are products of three planes (K-Planes, Fridovich-Keil et al., CVPR 2023, eq.
    1); small networks turn them into density, colour and a transient part. Most samples lie around
    the known depth or, if it is unknown, around the surface that a first pass finds. Coordinates
    beyond -1 and 1 are contracted. For ``num_images`` and ``num_lights`` see :class:`NerfW`.
    """

    def __init__(self, num_images: int, num_lights: int) -> None:
        super().__init__()
        self.planes = nn.ParameterList(
            nn.Parameter(torch.empty(3, _CHANNELS, size, size).uniform_(0.1, 0.5))
            for size in _RESOLUTIONS
        )
        self.geometry = _mlp(_CHANNELS * len(_RESOLUTIONS), 1 + _GEOMETRY)
        self.colour = _mlp(_GEOMETRY + 3 + 6 * _DIRECTION_FREQUENCIES + _APPEARANCE, 3)
        self.appearance = nn.Embedding(num_lights, _APPEARANCE)
        self.transient = nn.Embedding(num_images, _TRANSIENT)
        for embedding in (self.appearance, self.transient):
            nn.init.normal_(embedding.weight, std=0.1)
        self.moving = _mlp(3 + 6 * _POINT_FREQUENCIES + _TRANSIENT, 5)

    def density(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return density (N, S) and features (N, S, 15) at points (N, S, 3)."""
        inside = _contracted(points).reshape(-1, 3) / _REACH
        grid = torch.stack([inside[:, axes] for axes in _AXES])[:, :, None]
        features = [
            nn.functional.grid_sample(plane, grid, align_corners=True, padding_mode="border")
            .squeeze(-1)
            .prod(0)
            for plane in self.planes
        ]
        outputs = self.geometry(torch.cat(features).T).reshape(*points.shape[:2], -1)
        return torch.exp(outputs[..., 0].clamp(max=_MAX_LOG_DENSITY)), outputs[..., 1:]

    def render(self, rays: Rays, generator: torch.Generator | None = None) -> Rendered:
        t = self._where(rays, generator)
        count = t.shape[1]
        points = rays.points(t)
        deltas = spacings(t, rays)
        sigma, features = self.density(points)
        unit = nn.functional.normalize(rays.directions, dim=1)
        per_ray = [frequencies(unit, _DIRECTION_FREQUENCIES), rays.light(self.appearance)]
        inputs = torch.cat([features, _repeated(torch.cat(per_ray, dim=1), count)], dim=-1)
        rgb = torch.sigmoid(self.colour(inputs))
        if rays.transient is None:
            return composite(t, deltas, Samples(sigma, rgb))
        encoded = frequencies(_contracted(points), _POINT_FREQUENCIES)
        moving = self.moving(torch.cat([encoded, _repeated(rays.transient, count)], dim=-1))
        moving_rgb = torch.sigmoid(moving[..., 1:4])
        moving_sigma = nn.functional.softplus(moving[..., 0] - 3.0)
        beta = nn.functional.softplus(moving[..., 4] - 1.0)
        return composite(t, deltas, Samples(sigma, rgb, moving_sigma, moving_rgb, beta))

    @torch.no_grad()
    def _where(self, rays: Rays, generator: torch.Generator | None) -> torch.Tensor:
        depth = rays.depth
        spread = stratified(rays, _WHOLE_RAY, generator)
        near_surface = spread.new_zeros(len(spread), _NEAR_SURFACE)
        unknown = torch.arange(len(spread), device=spread.device)
        if depth is not None:
            near_surface = about_depth(depth, near_surface, generator)
            unknown = torch.nonzero(depth <= 0)[:, 0]
        if len(unknown):
            some = Rays(rays.origins[unknown], rays.directions[unknown], rays.near, rays.far)
            t = stratified(some, _TRAINING_PASS if generator else _RENDERING_PASS, generator)
            sigma = self.density(some.points(t))[0]
            passed = torch.cumsum(sigma * spacings(t, some), dim=1)
            left = torch.exp(-torch.cat([torch.zeros_like(passed[:, :1]), passed], dim=1))
            weights = left[:, :-1] - left[:, 1:]
            near_surface[unknown] = importance(t, weights, _NEAR_SURFACE, generator)
        return torch.sort(torch.cat([spread, near_surface], dim=1), dim=1).values


def _mlp(num_inputs: int, num_outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(num_inputs, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, num_outputs))


def _repeated(values: torch.Tensor, count: int) -> torch.Tensor:
    return values[:, None].expand(-1, count, -1)


def _contracted(points: torch.Tensor) -> torch.Tensor:
    """Contract coordinates beyond 1 smoothly (as in mip-NeRF 360, eq. 10)."""
    size = points.abs()
    margin = _REACH - 1.0
    outside = _REACH - margin**2 / (size.clamp_min(1.0) - 1.0 + margin)
    return torch.where(size <= 1.0, points, torch.sign(points) * outside)

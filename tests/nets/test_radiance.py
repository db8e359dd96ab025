"""Volume rendering against closed form; NeRF-W's loss and network against the paper's."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from megloc_kapture.nets.radiance import (
    NerfW,
    Rays,
    Rendered,
    Samples,
    TriPlane,
    _contracted,
    about_depth,
    composite,
    frequencies,
    importance,
    nerf_w_loss,
    spacings,
    stratified,
)


def rays_of(count: int, *, near: float = 0.5, far: float = 4.0, seed: int = 0) -> Rays:
    generator = torch.Generator().manual_seed(seed)
    directions = torch.randn(count, 3, generator=generator)
    return Rays(torch.zeros(count, 3), directions, near, far)


def slab(near: float, far: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Dense samples between two depths, and their spacings."""
    edges = torch.linspace(near, far, 4001, dtype=torch.float64)
    return (0.5 * (edges[1:] + edges[:-1]))[None], torch.diff(edges)[None]


def test_a_slab_of_constant_density_follows_beer_and_lambert() -> None:
    t, deltas = slab(1.0, 3.0)
    sigma, colour = 0.8, torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    samples = Samples(torch.full_like(t, sigma), colour.expand(1, t.shape[1], 3))
    result = composite(t, deltas, samples)
    opacity = 1 - math.exp(-sigma * 2)
    # the mean of an exponential distribution cut off at the slab's end
    depth = 1 + 1 / sigma - 2 * math.exp(-sigma * 2) / opacity
    assert result.opacity.item() == pytest.approx(opacity, abs=1e-12)
    assert result.depth.item() == pytest.approx(depth, rel=1e-6)
    torch.testing.assert_close(result.rgb[0], opacity * colour)
    assert result.beta.item() == pytest.approx(0.03)


def test_a_transient_slab_shares_the_light_by_density() -> None:
    t, deltas = slab(0.0, 1.0)
    ones = torch.ones_like(t)
    white = torch.ones(*t.shape, 3, dtype=torch.float64)
    result = composite(t, deltas, Samples(0.5 * ones, 0 * white, 1.5 * ones, white, 0.4 * ones))
    opacity = 1 - math.exp(-2.0)
    assert result.rgb[0, 0].item() == pytest.approx(0.75 * opacity, rel=1e-3)
    assert result.beta.item() == pytest.approx(0.03 + 0.4 * 0.75 * opacity, rel=1e-3)
    assert result.opacity.item() == pytest.approx(opacity, abs=1e-12)
    assert result.transient_density.item() == pytest.approx(1.5)


def test_the_loss_of_a_ray_by_hand() -> None:
    one = torch.ones(1)
    rendered = Rendered(torch.zeros(1, 3), one, one, 0.5 * one, one[None], torch.tensor(2.0))
    # squared error over twice the variance, logarithm of the deviation plus 3, and 0.01 * density
    expected = torch.tensor(1 / (2 * 0.5**2) + math.log(0.5) + 3 + 0.01 * 2)
    torch.testing.assert_close(nerf_w_loss(rendered, torch.ones(1, 3)), expected)


def test_samples_lie_where_they_should() -> None:
    rays = rays_of(50)
    generator = torch.Generator().manual_seed(1)
    t = stratified(rays, 32, generator)
    assert (torch.diff(t, dim=1) > 0).all() and t.min() >= 0.5 and t.max() <= 4.0
    weights = torch.where((t > 1.9) & (t < 2.1), 1.0, 0.0)
    more = importance(t, weights, 64, generator)
    assert ((more > 1.7) & (more < 2.3)).float().mean() > 0.98
    depth = torch.tensor([0.0, 2.0])
    result = about_depth(depth, torch.full((2, 8), 9.0), generator)
    assert (result[0] == 9).all() and ((result[1] - 2).abs() <= 0.06 + 1e-6).all()
    lengths = torch.linalg.vector_norm(rays.directions, dim=1)
    torch.testing.assert_close(spacings(t, rays).sum(1), (4.0 - t[:, 0]) * lengths)


def test_encoding_has_the_order_of_the_public_code() -> None:
    values = torch.tensor([[0.1, 0.2, 0.3]])
    result = frequencies(values, 2)
    expected = [values, values.sin(), values.cos(), (2 * values).sin(), (2 * values).cos()]
    torch.testing.assert_close(result, torch.cat(expected, dim=1))


def test_nerfw_has_the_sizes_of_the_public_code() -> None:
    field = NerfW(7, 7)
    # sums of (inputs + 1) * outputs over the layers of the public code
    sizes = [
        sum(value.numel() for value in net.parameters())
        for net in (field.nerf_coarse, field.nerf_fine)
    ]
    assert sizes == [595_844, 687_113]
    assert field.embedding_a.weight.shape == (7, 48) and field.embedding_t.weight.shape == (7, 16)
    assert tuple(field.state_dict()["nerf_fine.xyz_encoding_5.0.weight"].shape) == (256, 319)


@pytest.mark.parametrize("kind", [NerfW, TriPlane])
def test_a_field_renders_rays(kind: type[NerfW] | type[TriPlane]) -> None:
    torch.manual_seed(0)
    field = kind(3, 3)
    generator = torch.Generator().manual_seed(0)
    rays = rays_of(4)
    images = torch.arange(4) % 3
    full = replace(rays, appearance=field.appearance(images), transient=field.transient(images))
    seen = field.render(full, generator)
    for value, shape in ((seen.rgb, (4, 3)), (seen.depth, (4,)), (seen.beta, (4,))):
        assert value.shape == shape and torch.isfinite(value).all()
    assert ((seen.opacity >= 0) & (seen.opacity <= 1 + 1e-6)).all() and (seen.beta > 0.03).all()
    nerf_w_loss(seen, torch.rand(4, 3)).backward()
    assert all(value.grad is not None for value in field.parameters())
    plain = field.render(rays)
    assert (plain.beta == 0.03).all() and plain.transient_density == 0
    torch.testing.assert_close(plain.rgb, field.render(rays).rgb)
    other = replace(rays, appearance=field.appearance(images) + 1.0)
    assert not torch.equal(field.render(other).rgb, plain.rgb)


def test_space_beyond_the_planes_is_contracted_without_a_seam() -> None:
    points = torch.tensor([0.0, 0.5, 1.0, 1.0 + 1e-6, 3.0, 1e6, -3.0], dtype=torch.float64)
    result = _contracted(points)
    torch.testing.assert_close(result[:3], points[:3])
    assert (torch.diff(result[:6]) > 0).all() and result[5] < 1.25 and result[6] == -result[4]
    assert result[3].item() == pytest.approx(1 + 1e-6, abs=1e-10)

"""Gaussians along rays: against closed form, differences, all of them one by one, and gsplat."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from megloc_kapture.nets.gaussians import Gaussians
from megloc_kapture.nets.radiance import Rays, nerf_w_loss


def drawn(count: int, seed: int = 0) -> Gaussians:
    """Gaussians of all shapes in the ball about the origin."""
    torch.manual_seed(seed)
    field = Gaussians(3, count=count)
    with torch.no_grad():
        field.means.normal_(std=0.3)
        field.log_scales.normal_(mean=-2.5, std=0.4)
        field.quats_wxyz.normal_()
        field.opacity_logits.normal_(std=1.5)
        field.colour_logits.normal_()
        field.light.normal_(std=0.3)
    return field


def towards(count: int, seed: int = 1) -> Rays:
    """Rays from z = -2 into the ball, z = 1 in their directions."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.randn(count, 3, generator=generator) * 0.2
    directions[:, 2] = 1.0
    return Rays(torch.tensor([[0.0, 0.0, -2.0]]).repeat(count, 1), directions, 0.1, 10.0)


def test_one_gaussian_is_closed_form() -> None:
    field = Gaussians(2, count=1)
    rotation = Rotation.from_euler("xyz", [20.0, -35.0, 50.0], degrees=True)
    scales, mean, opacity = np.array([0.1, 0.3, 0.2]), np.array([0.1, -0.05, 1.0]), 0.7
    with torch.no_grad():
        field.means[0] = torch.tensor(mean)
        field.log_scales[0] = torch.tensor(np.log(scales))
        field.quats_wxyz[0] = 2.5 * torch.tensor(rotation.as_quat()[[3, 0, 1, 2]])
        field.opacity_logits[0] = math.log(opacity / (1 - opacity))
        field.colour_logits[0] = torch.tensor([0.5, -1.0, 2.0])
    covariance = rotation.as_matrix() @ np.diag(scales**2) @ rotation.as_matrix().T
    directions = np.array([[0.0, 0.0, 1.0], [0.15, -0.1, 1.0], [0.3, 0.2, 1.0]])
    rays = Rays(torch.zeros(3, 3), torch.tensor(directions, dtype=torch.float32), 0.1, 5.0)
    found = field.render(rays)
    inverse = np.linalg.inv(covariance)
    for number, direction in enumerate(directions):
        t = direction @ inverse @ mean / (direction @ inverse @ direction)
        away = t * direction - mean
        alpha = opacity * math.exp(-0.5 * away @ inverse @ away)
        assert found.opacity[number].item() == pytest.approx(alpha, rel=1e-4)
        assert found.depth[number].item() == pytest.approx(t, rel=1e-4)
        seen = alpha / (1 + np.exp([-0.5, 1.0, -2.0]))
        np.testing.assert_allclose(found.rgb[number].detach().numpy(), seen, rtol=1e-4)
    behind = field.render(replace(rays, directions=-rays.directions))
    assert (behind.opacity == 0).all() and (behind.rgb == 0).all() and (behind.depth == 0).all()


@pytest.mark.parametrize("table", [1 << 18, 900])
def test_tables_miss_no_gaussian(table: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("megloc_kapture.nets.gaussians._TABLE_OF_CACHE", table)
    monkeypatch.setattr("megloc_kapture.nets.gaussians._DEPTH_OF_RAY", 300)
    field, rays = drawn(300), towards(40)
    found = field.render(rays).rgb.detach()
    colours = field.colours(field.appearance.weight.mean(0))
    whitening = field._whitening()
    for row in range(40):
        origin = torch.einsum("kij,kj->ki", whitening, rays.origins[row] - field.means)
        ahead = torch.einsum("kij,j->ki", whitening, rays.directions[row])
        distance = torch.linalg.cross(origin, ahead).norm(dim=1) / ahead.norm(dim=1)
        alpha = torch.sigmoid(field.opacity_logits) * torch.exp(-0.5 * distance**2)
        t = -(origin * ahead).sum(1) / (ahead * ahead).sum(1)
        left, seen = 1.0, torch.zeros(3)
        for one in torch.argsort(t).tolist():
            if alpha[one] > 1 / 255:
                seen = seen + left * alpha[one] * colours[one]
                left = left * (1 - alpha[one])
        torch.testing.assert_close(found[row], seen.detach(), atol=2e-3, rtol=0)


def test_gradients_are_those_of_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Gaussians, "forward", Gaussians.render)
    field, rays = drawn(20).double(), towards(6)
    rows = [0, 1, 2, 0, 1, 2]
    light, moving = (part.weight[rows].detach() for part in (field.appearance, field.transient))
    origins, directions = rays.origins.double(), rays.directions.double()
    rays = Rays(origins, directions, rays.near, rays.far, light, moving)
    names = ["means", "log_scales", "quats_wxyz", "opacity_logits", "colour_logits", "light"]
    seen = torch.rand(6, 3, dtype=torch.float64)

    def loss(*values: torch.Tensor) -> torch.Tensor:
        changed = dict(zip(names, values, strict=True))
        found = torch.func.functional_call(field, changed, (rays,))
        return nerf_w_loss(found, seen) + found.depth.sum()

    values = [getattr(field, name).detach().clone().requires_grad_() for name in names]
    # along a random direction of each
    assert torch.autograd.gradcheck(loss, values, eps=1e-7, atol=1e-4, fast_mode=True)


def test_what_is_transient_stands_before_all() -> None:
    field, rays = drawn(200), towards(9)
    plain = field.render(rays)
    assert (plain.beta == 0.03).all() and plain.transient_density == 0
    images = torch.arange(9) % 3
    moving = field.render(replace(rays, transient=field.transient(images)))
    assert (moving.beta > 0.03).all() and moving.transient_density > 0
    torch.testing.assert_close(moving.depth, plain.depth)  # it is the scene's
    other = field.render(replace(rays, appearance=field.appearance(images) + 1.0))
    assert not torch.equal(other.rgb, plain.rgb)
    nerf_w_loss(moving, torch.rand(9, 3)).backward()
    assert all(value.grad is not None for value in field.parameters() if value.dim() > 1)


def test_gaussians_are_placed_as_large_as_their_surroundings() -> None:
    points = np.stack(np.meshgrid(*[np.arange(5.0)] * 3), axis=-1).reshape(-1, 3) * 0.1
    field = Gaussians(2, count=125)
    rgb = np.random.default_rng(0).uniform(0.1, 0.9, (125, 3)).astype(np.float32)
    field.place(points.astype(np.float32), rgb)
    torch.testing.assert_close(torch.exp(field.log_scales), torch.full((125, 3), 0.1))
    torch.testing.assert_close(field.colours(torch.zeros(8)), torch.from_numpy(rgb))


@pytest.mark.skipif(
    not torch.cuda.is_available() or find_spec("gsplat") is None, reason="needs a GPU and gsplat"
)
def test_gsplat_renders_the_same() -> None:
    field = drawn(400).cuda()
    calibration = torch.tensor([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]], device="cuda")
    pose = torch.eye(4, device="cuda")
    pose[2, 3] = 2.0
    with torch.no_grad():
        rgb, depth, opacity = field.rasterize(pose, calibration, (80, 60), None)
        y, x = torch.meshgrid(*(torch.arange(n, device="cuda") + 0.5 for n in (60, 80)))
        directions = torch.stack([(x - 40) / 80, (y - 30) / 80, torch.ones_like(x)], dim=-1)
        origins = torch.tensor([[0.0, 0, -2]], device="cuda").expand(4800, 3)
        found = field.render(Rays(origins, directions.reshape(-1, 3), 0.1, 10.0))
    # its order of Gaussians is that of their centres, ours that along the ray
    assert (rgb.reshape(-1, 3) - found.rgb).abs().quantile(0.95) < 0.02
    assert (opacity.ravel() - found.opacity).abs().quantile(0.95) < 0.01
    solid = found.opacity > 0.5
    assert (depth.ravel() - found.depth)[solid].abs().quantile(0.95) < 0.05

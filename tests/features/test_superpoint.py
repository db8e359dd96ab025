"""SuperPoint against transformers, its batch-norm variant, and separate descriptor weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from images import texture
from published import Tensors, plugin, random_tensors
from torch.nn import functional
from transformers import SuperPointConfig, SuperPointForKeypointDetection

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.features import superpoint
from megloc_kapture.features.superpoint import (
    SuperPoint,
    SuperPointNet,
    gray_tensor,
    sample_descriptors,
    superpoint_from,
)
from megloc_kapture.io.weights import find_weights

CPU = torch.device("cpu")


def test_borders_hold_no_keypoints_and_a_threshold_keeps_the_best(superpoint_weights: Path) -> None:
    image = texture(80, 107, sigma_px=1.5)
    result = plugin(SuperPoint, superpoint_weights).extract(image)
    assert len(result.scores) > 30
    assert result.keypoints_px[:, :2].min() >= 4.5
    # width and height are cut to multiples of 8
    assert (result.keypoints_px[:, :2].max(axis=0) <= np.array([104, 80]) - 4.5).all()
    strong = plugin(SuperPoint, superpoint_weights, threshold=float(result.scores[20])).extract(
        image
    )
    np.testing.assert_array_equal(strong.keypoints_px, result.keypoints_px[:20])


def transformers_model(weights: Tensors, **options: int) -> SuperPointForKeypointDetection:
    model = SuperPointForKeypointDetection(SuperPointConfig(**options)).eval()
    # both list the layers in the same order
    model.load_state_dict(dict(zip(model.state_dict(), weights.values(), strict=True)))
    return model


@pytest.mark.parametrize(("height", "width"), [(72, 96), (67, 90)])
def test_keypoints_equal_transformers(
    superpoint_weights: Path, height: int, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(superpoint, "_BORDER_PX", 0)
    image = texture(height, width, sigma_px=1.5)
    result = plugin(SuperPoint, superpoint_weights, max_keypoints=100).extract(image)
    state = torch.load(superpoint_weights, weights_only=True)
    model = transformers_model(state, border_removal_distance=0, max_keypoints=100, nms_radius=4)
    with torch.inference_mode():
        expected = model(gray_tensor(image, CPU).expand(1, 3, -1, -1))
    xy = expected.keypoints[0] * torch.tensor([width, height]) + 0.5
    assert len(xy) > 20 and result.scores.std() > 0.1 * result.scores.mean()
    np.testing.assert_allclose(result.keypoints_px[:, :2], xy.numpy(), atol=1e-3)
    np.testing.assert_allclose(result.scores, expected.scores[0].numpy(), atol=1e-6)
    np.testing.assert_allclose(result.descriptors, expected.descriptors[0].numpy(), atol=1e-5)


def test_gray_is_luma_rounded_to_eight_bits() -> None:
    image = np.random.default_rng(0).integers(0, 256, (16, 24, 3), np.uint8)
    levels = gray_tensor(image, CPU).numpy()[0, 0] * 255
    np.testing.assert_allclose(levels, levels.round(), atol=1e-4)
    luma = image.astype(np.float64) @ [0.299, 0.587, 0.114]
    assert np.abs(levels - luma).max() < 0.51  # cv2 counts in fixed point


def test_the_batch_norm_variant_is_recognised(superpoint_weights: Path, tmp_path: Path) -> None:
    path = tmp_path / "superpoint_v6_from_tf.pth"
    torch.save(random_tensors("superpoint-batchnorm"), path)
    image = texture(64, 80, sigma_px=1.5)
    batchnorm = plugin(SuperPoint, path)
    assert batchnorm.name == "superpoint-v6_from_tf"
    official = batchnorm.extract(image)
    exact = plugin(SuperPoint, path, descriptor_sampling="exact").extract(image)
    np.testing.assert_array_equal(official.descriptors, exact.descriptors)
    assert len(official.scores) > 10
    with pytest.raises(OptionError, match="descriptor_weights"):
        plugin(SuperPoint, path, descriptor_weights=str(superpoint_weights)).extract(image)


BACKBONE = ("conv1", "conv2", "conv3", "conv4")


def random_gray(height: int, width: int, seed: int = 0) -> torch.Tensor:
    return torch.rand((1, 1, height, width), generator=torch.Generator().manual_seed(seed))


def test_exact_sampling_interpolates_at_the_centres_of_cells() -> None:
    # a map that is linear in the cell, and constant in the third channel
    v, u = torch.meshgrid(torch.arange(6) + 1.0, torch.arange(10) + 1.0, indexing="ij")
    x = torch.arange(4, 80 - 4)
    xy = torch.stack([x, torch.full_like(x, 20)], dim=1)
    sampled = sample_descriptors(torch.stack([u, v, torch.ones_like(u)]), xy, "exact")
    torch.testing.assert_close(sampled.norm(dim=1), torch.ones(len(xy)))
    cells = sampled[:, :2] / sampled[:, 2:] - 1
    torch.testing.assert_close(cells, (xy - 3.5) / 8, rtol=0, atol=1e-5)


def parts(weights: Tensors, *prefixes: str) -> Tensors:
    return {key: value for key, value in weights.items() if key.startswith(prefixes)}


def combined(detector: Tensors, descriptor: Tensors, folder: Path) -> SuperPointNet:
    torch.save(descriptor, folder / "b.pth")
    net = superpoint_from(detector, "a.pth", find_weights(str(folder / "b.pth")))
    assert isinstance(net, SuperPointNet)
    return net


@torch.inference_mode()
@pytest.mark.parametrize("kept", [(*BACKBONE, "convD"), ("conv",)])
def test_a_separate_descriptor_network(kept: tuple[str, ...], tmp_path: Path) -> None:
    frozen, tuned = random_tensors("superpoint", 3), random_tensors("superpoint", 4)
    net = combined(frozen, parts(tuned, *kept), tmp_path)
    assert net.describer is not None
    gray = random_gray(40, 48)
    scores, descriptors = net.eval()(gray)
    assert torch.equal(scores, superpoint_from(frozen, "a.pth").eval()(gray)[0])
    assert torch.equal(descriptors, superpoint_from(tuned, "b.pth").eval()(gray)[1])


@torch.inference_mode()
def test_a_descriptor_head_on_the_detectors_features(tmp_path: Path) -> None:
    frozen, tuned = random_tensors("superpoint", 3), random_tensors("superpoint", 4)
    net = combined(parts(frozen, *BACKBONE, "convP"), parts(tuned, "convD"), tmp_path)
    gray = random_gray(40, 48)
    scores, descriptors = net.eval()(gray)
    whole = superpoint_from(frozen, "a.pth").eval()
    assert torch.equal(scores, whole(gray)[0])
    head = SuperPointNet(detector=False).eval()
    head.load_state_dict({**parts(frozen, *BACKBONE), **parts(tuned, "convD")})
    assert torch.equal(descriptors, head.describe(whole.encode(gray)))
    assert not torch.allclose(descriptors, whole(gray)[1], atol=0.1)


def test_unsuitable_checkpoints_are_named(tmp_path: Path) -> None:
    weights = random_tensors("superpoint", 5)
    with pytest.raises(DataError, match=r"a\.pth: .*convPa\.bias"):
        combined(parts(weights, *BACKBONE), weights, tmp_path)
    for wrong in (
        parts(weights, "conv4", "convD"),  # half a backbone
        {**parts(weights, "convD"), "scale": torch.ones(1)},
    ):
        with pytest.raises(DataError, match=r"b\.pth: "):
            combined(weights, wrong, tmp_path)


@torch.inference_mode()
def test_batch_normalisation_follows_the_activation() -> None:
    # float64: activations grow, and float32 differs between processors by as much as the bound
    net = superpoint_from(random_tensors("superpoint-batchnorm", 1), "w.pth").eval().double()
    weights = net.state_dict()

    def block(x: torch.Tensor, name: str, *, relu: bool = True) -> torch.Tensor:
        kernel = weights[f"{name}.conv.weight"]
        x = functional.conv2d(
            x, kernel, weights[f"{name}.conv.bias"], padding=kernel.shape[-1] // 2
        )
        x = x.clamp(min=0) if relu else x
        kinds = ("running_mean", "running_var", "weight", "bias")
        return functional.batch_norm(x, *(weights[f"{name}.bn.{k}"] for k in kinds), eps=1e-3)

    gray = random_gray(45, 58).double()
    x = gray
    for stage in range(4):
        x = block(block(x, f"backbone.{stage}.0"), f"backbone.{stage}.1")
        x = functional.max_pool2d(x, 2) if stage < 3 else x
    logits = block(block(x, "detector.0"), "detector.1", relu=False)
    described = block(block(x, "descriptor.0"), "descriptor.1", relu=False)
    scores, descriptors = net(gray)
    probabilities = logits.softmax(dim=1)[0, :64].view(8, 8, 5, 7)
    expected = probabilities.permute(2, 0, 3, 1).reshape(40, 56)
    torch.testing.assert_close(scores[0], expected.float(), rtol=0, atol=1e-5)
    expected = described / described.norm(dim=1, keepdim=True)
    torch.testing.assert_close(descriptors, expected, rtol=0, atol=1e-5)

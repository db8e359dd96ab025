"""The SuperPoint plugin with random weights: coordinates, borders, sampling and files."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from images import texture
from published import Tensors, random_tensors
from torch.nn import functional
from transformers import SuperPointConfig, SuperPointForKeypointDetection

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.features.superpoint import (
    DescriptorSampling,
    SplitSuperPoint,
    SuperPoint,
    SuperPointBatchNormNet,
    SuperPointNet,
    SuperPointOptions,
    gray_tensor,
    sample_descriptors,
    superpoint_from,
    superpoint_with_descriptor,
)

CPU = torch.device("cpu")


def extractor(weights: Path, **options: object) -> SuperPoint:
    given = {"weights": str(weights), "device": "cpu", **options}
    return SuperPoint(SuperPointOptions.model_validate(given))


def test_ties_borders_and_the_threshold(superpoint_weights: Path) -> None:
    image = texture(120, 163, sigma_px=1.5)
    result = extractor(superpoint_weights).extract(image)
    assert len(result.scores) > 60
    keys = [(-s, y, x) for x, y, s in result.keypoints_px.tolist()]
    assert keys == sorted(keys)
    assert result.keypoints_px[:, :2].min() >= 4.5
    assert result.keypoints_px[:, 0].max() <= 160 - 4.5  # the part of a multiple of 8
    assert result.keypoints_px[:, 1].max() <= 120 - 4.5
    strong = extractor(superpoint_weights, threshold=float(result.scores[30])).extract(image)
    np.testing.assert_array_equal(strong.keypoints_px, result.keypoints_px[:30])


def test_keypoints_equal_transformers(superpoint_weights: Path) -> None:
    image = texture(96, 128, sigma_px=1.5)
    result = extractor(superpoint_weights, remove_borders=0, max_keypoints=100).extract(image)
    state = torch.load(superpoint_weights, weights_only=True)
    config = SuperPointConfig(border_removal_distance=0, max_keypoints=100, nms_radius=4)
    model = SuperPointForKeypointDetection(config).eval()
    # both list the layers in the same order
    model.load_state_dict(dict(zip(model.state_dict(), state.values(), strict=True)))
    gray = gray_tensor(image, CPU)
    with torch.inference_mode():
        expected = model(gray.expand(1, 3, -1, -1))
    xy = expected.keypoints[0] * torch.tensor([128, 96]) + 0.5
    np.testing.assert_allclose(result.keypoints_px[:, :2], xy.numpy(), atol=1e-3)
    np.testing.assert_allclose(result.scores, expected.scores[0].numpy(), atol=1e-6)
    np.testing.assert_allclose(result.descriptors, expected.descriptors[0].numpy(), atol=1e-5)


def test_gray_is_luma_rounded_to_eight_bits() -> None:
    image = np.random.default_rng(0).integers(0, 256, (16, 24, 3), np.uint8)
    levels = gray_tensor(image, CPU).numpy()[0, 0] * 255
    np.testing.assert_allclose(levels, levels.round(), atol=1e-4)
    luma = image.astype(np.float64) @ [0.299, 0.587, 0.114]
    assert np.abs(levels - luma).max() < 0.51  # cv2 counts in fixed point


def test_sampling_leaves_keypoints(superpoint_weights: Path) -> None:
    image = texture(120, 160, sigma_px=1.5)
    official = extractor(superpoint_weights).extract(image)
    exact = extractor(superpoint_weights, descriptor_sampling="exact").extract(image)
    np.testing.assert_array_equal(exact.keypoints_px, official.keypoints_px)
    cosine = (exact.descriptors * official.descriptors).sum(axis=1)
    assert cosine[official.keypoints_px[:, 0] > 120].mean() < 0.999


def test_a_second_checkpoint_gives_the_descriptors_and_another_type(
    superpoint_weights: Path, other_superpoint: dict[str, torch.Tensor], tmp_path: Path
) -> None:
    image = texture(80, 96, sigma_px=1.5)
    tuned, state = tmp_path / "megadepth.pth", other_superpoint
    torch.save({k: v for k, v in state.items() if not k.startswith("convP")}, tuned)
    plugin = extractor(superpoint_weights, descriptor_weights=str(tuned))
    alone = extractor(superpoint_weights)
    assert (alone.name, plugin.name) == ("superpoint", "superpoint-megadepth")
    assert SuperPoint.name == "superpoint"
    assert plugin.weights() == {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in (superpoint_weights, tuned)
    }
    assert list(alone.weights()) == ["superpoint_v1.pth"]
    result, frozen = plugin.extract(image), alone.extract(image)
    np.testing.assert_array_equal(result.keypoints_px, frozen.keypoints_px)
    whole = tmp_path / "other.pth"
    torch.save({**torch.load(superpoint_weights, weights_only=True), **state}, whole)
    assert extractor(whole).name == "superpoint-other"
    assert np.abs(result.descriptors - frozen.descriptors).max() > 0.1


def test_the_batch_norm_variant_is_known_by_its_keys(
    superpoint_weights: Path, tmp_path: Path
) -> None:
    torch.manual_seed(2)
    path = tmp_path / "superpoint_v6_from_tf.pth"
    torch.save(SuperPointBatchNormNet().state_dict(), path)
    image = texture(80, 96, sigma_px=1.5)
    plugin = extractor(path)
    assert plugin.name == "superpoint-v6_from_tf"
    official = plugin.extract(image)
    exact = extractor(path, descriptor_sampling="exact").extract(image)
    np.testing.assert_array_equal(official.descriptors, exact.descriptors)
    assert len(official.scores) > 10
    with pytest.raises(OptionError, match="descriptor_weights"):
        extractor(path, descriptor_weights=str(superpoint_weights)).extract(image)


BACKBONE = ("conv1", "conv2", "conv3", "conv4")


def random_gray(height: int, width: int, seed: int = 0) -> torch.Tensor:
    return torch.rand((1, 1, height, width), generator=torch.Generator().manual_seed(seed))


def transformers_model(weights: Tensors) -> SuperPointForKeypointDetection:
    """With the weights under its own names, and no suppression."""
    names = {}
    for letter in "ab":
        names[f"convP{letter}"] = f"keypoint_decoder.conv_score_{letter}"
        names[f"convD{letter}"] = f"descriptor_decoder.conv_descriptor_{letter}"
        for block in range(4):
            names[f"conv{block + 1}{letter}"] = f"encoder.conv_blocks.{block}.conv_{letter}"
    model = SuperPointForKeypointDetection(SuperPointConfig(nms_radius=0)).eval()
    renamed = {}
    for key, value in weights.items():
        layer, kind = key.split(".")
        renamed[f"{names[layer]}.{kind}"] = value
    model.load_state_dict(renamed)
    return model


@torch.inference_mode()
@pytest.mark.parametrize("size", [(63, 70), (64, 65), (66, 64), (130, 67), (131, 64), (197, 80)])
def test_maps_of_any_size_are_transformers(size: tuple[int, int]) -> None:
    weights = random_tensors("superpoint", 2)
    gray = random_gray(*size)
    scores, descriptors = superpoint_from(weights, "w.pth").eval()(gray)
    assert scores.shape == (1, size[0] // 8 * 8, size[1] // 8 * 8)
    assert descriptors.shape == (1, 256, size[0] // 8, size[1] // 8)
    model = transformers_model(weights)
    features = model.encoder(gray)[0]
    expected = model.keypoint_decoder._get_pixel_scores(features)
    assert scores.std() > 0.1 * scores.mean()  # not the same everywhere
    torch.testing.assert_close(scores, expected, rtol=0, atol=1e-6)
    decoder = model.descriptor_decoder
    expected = decoder.conv_descriptor_b(decoder.relu(decoder.conv_descriptor_a(features)))
    expected = functional.normalize(expected, dim=1)
    torch.testing.assert_close(descriptors, expected, rtol=0, atol=1e-6)


def cells_at(
    xy: torch.Tensor, height: int, width: int, sampling: DescriptorSampling
) -> torch.Tensor:
    """Where in cells descriptors are read: a map that is linear in the cell gives it away."""
    v, u = torch.meshgrid(torch.arange(height) + 1.0, torch.arange(width) + 1.0, indexing="ij")
    sampled = sample_descriptors(torch.stack([u, v, torch.ones_like(u)]), xy, sampling)
    torch.testing.assert_close(sampled.norm(dim=1), torch.ones(len(xy)))
    return sampled[:, :2] / sampled[:, 2:] - 1


def test_exact_sampling_reads_a_linear_map() -> None:
    x = torch.arange(4, 80 - 4)
    xy = torch.stack([x, torch.full_like(x, 20)], dim=1)
    result = cells_at(xy, 6, 10, "exact")
    torch.testing.assert_close(result, (xy - 3.5) / 8, rtol=0, atol=1e-5)


def parts(weights: Tensors, *prefixes: str) -> Tensors:
    return {key: value for key, value in weights.items() if key.startswith(prefixes)}


@torch.inference_mode()
@pytest.mark.parametrize("kept", [(*BACKBONE, "convD"), ("conv",)])
def test_a_separate_descriptor_network(kept: tuple[str, ...]) -> None:
    frozen, tuned = random_tensors("superpoint", 3), random_tensors("superpoint", 4)
    net = superpoint_with_descriptor(
        frozen, parts(tuned, *kept), detector_where="a.pth", descriptor_where="b.pth"
    )
    assert isinstance(net, SplitSuperPoint)
    gray = random_gray(40, 48)
    scores, descriptors = net.eval()(gray)
    assert torch.equal(scores, superpoint_from(frozen, "a.pth").eval()(gray)[0])
    assert torch.equal(descriptors, superpoint_from(tuned, "b.pth").eval()(gray)[1])


@torch.inference_mode()
def test_a_descriptor_head_on_the_detectors_features() -> None:
    frozen, tuned = random_tensors("superpoint", 3), random_tensors("superpoint", 4)
    net = superpoint_with_descriptor(
        parts(frozen, *BACKBONE, "convP"),
        parts(tuned, "convD"),
        detector_where="a.pth",
        descriptor_where="b.pth",
    )
    gray = random_gray(40, 48)
    scores, descriptors = net.eval()(gray)
    whole = superpoint_from(frozen, "a.pth").eval()
    assert torch.equal(scores, whole(gray)[0])
    head = SuperPointNet(detector=False).eval()
    head.load_state_dict({**parts(frozen, *BACKBONE), **parts(tuned, "convD")})
    assert torch.equal(descriptors, head.describe(whole.encode(gray)))
    assert not torch.allclose(descriptors, whole(gray)[1], atol=0.1)


def test_a_checkpoint_that_does_not_fit_is_named() -> None:
    weights = random_tensors("superpoint", 5)
    with pytest.raises(DataError, match=r"a\.pth: .*convPa\.bias"):
        superpoint_with_descriptor(
            parts(weights, *BACKBONE), weights, detector_where="a.pth", descriptor_where="b.pth"
        )
    for wrong in (
        parts(weights, "conv4", "convD"),  # half a backbone
        parts(weights, *BACKBONE),
        {**parts(weights, "convD"), "scale": torch.ones(1)},
    ):
        with pytest.raises(DataError, match=re.escape("b.pth: ")):
            superpoint_with_descriptor(
                weights, wrong, detector_where="a.pth", descriptor_where="b.pth"
            )


@torch.inference_mode()
def test_the_normalisation_follows_the_activation() -> None:
    # float64: activations grow, and float32 differs between processors by as much as the bound
    net = superpoint_from(random_tensors("superpoint-batchnorm", 1), "w.pth").eval().double()
    weights = net.state_dict()

    def block(x: torch.Tensor, name: str, *, relu: bool = True) -> torch.Tensor:
        kernel = weights[f"{name}.conv.weight"]
        x = functional.conv2d(
            x, kernel, weights[f"{name}.conv.bias"], padding=kernel.shape[-1] // 2
        )
        x = x.clamp(min=0) if relu else x
        mean, var, gain, bias = (
            weights[f"{name}.bn.{kind}"][:, None, None]
            for kind in ("running_mean", "running_var", "weight", "bias")
        )
        return (x - mean) / (var + 1e-3).sqrt() * gain + bias

    gray = random_gray(61, 74).double()
    x = gray
    for stage in range(4):
        x = block(block(x, f"backbone.{stage}.0"), f"backbone.{stage}.1")
        x = functional.max_pool2d(x, 2) if stage < 3 else x
    logits = block(block(x, "detector.0"), "detector.1", relu=False)
    described = block(block(x, "descriptor.0"), "descriptor.1", relu=False)
    scores, descriptors = net(gray)
    probabilities = logits.softmax(dim=1)[0, :64].view(8, 8, 7, 9)
    expected = probabilities.permute(2, 0, 3, 1).reshape(56, 72)
    torch.testing.assert_close(scores[0], expected.float(), rtol=0, atol=1e-5)
    expected = described / described.norm(dim=1, keepdim=True)
    torch.testing.assert_close(descriptors, expected, rtol=0, atol=1e-5)

"""The SuperPoint plugin with random weights: coordinates, borders, sampling and files."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from images import texture
from transformers import SuperPointConfig, SuperPointForKeypointDetection

from megloc_kapture.errors import OptionError
from megloc_kapture.features.superpoint import SuperPoint, SuperPointOptions, gray_tensor
from megloc_kapture.nets.superpoint import SuperPointBatchNormNet, SuperPointNet

CPU = torch.device("cpu")


def extractor(weights: Path, **options: object) -> SuperPoint:
    given = {"weights": str(weights), "device": "cpu", **options}
    return SuperPoint(SuperPointOptions.model_validate(given))


def bright_cell_detector() -> SuperPointNet:
    """Fires at row 5, column 2 of a cell of 8 x 8 pixels that has a bright pixel anywhere."""
    net = SuperPointNet()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.zero_()
        for name, layer in net.named_children():
            if name not in ("convPb", "convDb"):
                layer.get_parameter("weight")[0, 0, 1, 1] = 1.0  # passes its input on
        net.convPb.weight[8 * 5 + 2, 0] = 30.0
        net.convPb.bias[64] = 10.0
        net.convDb.bias[0] = 1.0
    return net


def test_a_keypoint_stands_at_the_middle_of_its_pixel(tmp_path: Path) -> None:
    path = tmp_path / "superpoint_v1.pth"
    torch.save(bright_cell_detector().state_dict(), path)
    image = np.zeros((48, 64, 3), np.uint8)
    image[19, 45] = 255  # cell (2, 5), whose keypoint is pixel (x 42, y 21)
    found = extractor(path).extract(image)
    np.testing.assert_array_equal(found.keypoints_px[:, :2], [[42.5, 21.5]])
    assert found.keypoints_px[0, 2] == found.scores[0] > 0.99
    assert found.keypoints_px.dtype == found.scores.dtype == found.descriptors.dtype == np.float32


def test_ties_borders_and_the_threshold(superpoint_weights: Path) -> None:
    image = texture(120, 163, sigma_px=1.5)
    found = extractor(superpoint_weights).extract(image)
    assert len(found.scores) > 60
    keys = [(-s, y, x) for x, y, s in found.keypoints_px.tolist()]
    assert keys == sorted(keys)
    assert found.keypoints_px[:, :2].min() >= 4.5
    assert found.keypoints_px[:, 0].max() <= 160 - 4.5  # of what is a multiple of 8
    assert found.keypoints_px[:, 1].max() <= 120 - 4.5
    strong = extractor(superpoint_weights, threshold=float(found.scores[30])).extract(image)
    np.testing.assert_array_equal(strong.keypoints_px, found.keypoints_px[:30])


def test_the_whole_is_transformers_on_the_same_gray_image(superpoint_weights: Path) -> None:
    image = texture(96, 128, sigma_px=1.5)
    found = extractor(superpoint_weights, remove_borders=0, max_keypoints=100).extract(image)
    state = torch.load(superpoint_weights, weights_only=True)
    config = SuperPointConfig(border_removal_distance=0, max_keypoints=100, nms_radius=4)
    model = SuperPointForKeypointDetection(config).eval()
    # both list the layers in the same order
    model.load_state_dict(dict(zip(model.state_dict(), state.values(), strict=True)))
    gray = gray_tensor(image, CPU)
    with torch.inference_mode():
        expected = model(gray.expand(1, 3, -1, -1))
    xy = expected.keypoints[0] * torch.tensor([128, 96]) + 0.5
    np.testing.assert_allclose(found.keypoints_px[:, :2], xy.numpy(), atol=1e-3)
    np.testing.assert_allclose(found.scores, expected.scores[0].numpy(), atol=1e-6)
    np.testing.assert_allclose(found.descriptors, expected.descriptors[0].numpy(), atol=1e-5)


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
    found, frozen = plugin.extract(image), alone.extract(image)
    np.testing.assert_array_equal(found.keypoints_px, frozen.keypoints_px)
    whole = tmp_path / "other.pth"
    torch.save({**torch.load(superpoint_weights, weights_only=True), **state}, whole)
    assert extractor(whole).name == "superpoint-other"
    assert np.abs(found.descriptors - frozen.descriptors).max() > 0.1


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

"""The SuperPoint plugin with random weights: coordinates, masks, limits, types and files."""

from __future__ import annotations

import hashlib
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from transformers import SuperPointConfig, SuperPointForKeypointDetection

from megloc_kapture.errors import DataError, MeglocError, OptionError
from megloc_kapture.features.superpoint import SuperPoint, SuperPointOptions, gray_tensor
from megloc_kapture.nets.superpoint import SuperPointBatchNormNet, SuperPointNet
from megloc_kapture.values import LocalFeatures

Image = NDArray[np.uint8]
CPU = torch.device("cpu")


def random_net(seed: int) -> SuperPointNet:
    torch.manual_seed(seed)
    net = SuperPointNet()
    for name, value in net.named_parameters():
        if name.endswith("weight"):
            torch.nn.init.kaiming_normal_(value)
    return net


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "superpoint_v1.pth"
    torch.save(random_net(0).state_dict(), path)
    return path


def extractor(weights: Path, **options: object) -> SuperPoint:
    return SuperPoint(
        SuperPointOptions.model_validate({"weights": str(weights), "device": "cpu", **options})
    )


def texture(height: int, width: int, seed: int = 0) -> Image:
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


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


def test_best_first_limited_and_with_scores(weights: Path) -> None:
    image = texture(120, 163)
    found = extractor(weights).extract(image)
    assert found.keypoints_px.shape == (len(found.scores), 3)
    assert found.descriptors.shape == (len(found.scores), 256)
    assert len(found.scores) > 60
    np.testing.assert_array_equal(found.keypoints_px[:, 2], found.scores)
    keys = [(-s, y, x) for x, y, s in found.keypoints_px.tolist()]
    assert keys == sorted(keys)
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-5)
    assert found.keypoints_px[:, :2].min() >= 4.5
    assert found.keypoints_px[:, 0].max() <= 160 - 4.5  # of what is a multiple of 8
    assert found.keypoints_px[:, 1].max() <= 120 - 4.5
    few = extractor(weights, max_keypoints=20).extract(image)
    np.testing.assert_array_equal(few.keypoints_px, found.keypoints_px[:20])
    np.testing.assert_array_equal(few.descriptors, found.descriptors[:20])
    strong = extractor(weights, threshold=float(found.scores[30])).extract(image)
    np.testing.assert_array_equal(strong.keypoints_px, found.keypoints_px[:30])


def test_the_whole_is_transformers_on_the_same_gray_image(weights: Path) -> None:
    image = texture(96, 128)
    found = extractor(weights, remove_borders=0, max_keypoints=100).extract(image)
    state = torch.load(weights, weights_only=True)
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


def test_masked_keypoints_make_room_for_others(weights: Path) -> None:
    image = texture(120, 163)
    everything = extractor(weights).extract(image)
    mask = np.ones((120, 163), bool)
    mask[:, :60] = False
    off = everything.keypoints_px[:, 0] < 60
    assert 10 < off.sum() < len(off)
    found = extractor(weights, max_keypoints=25).extract(image, mask)
    np.testing.assert_array_equal(found.keypoints_px, everything.keypoints_px[~off][:25])
    assert found.num_masked == off.sum()
    assert everything.num_masked == 0


def assert_empty(found: LocalFeatures) -> None:
    assert found.keypoints_px.shape == (0, 3)
    assert found.scores.shape == (0,)
    assert found.descriptors.shape == (0, 256)


def test_images_without_keypoints(weights: Path) -> None:
    assert_empty(extractor(weights).extract(texture(7, 100)))
    assert_empty(extractor(weights).extract(texture(8, 8)))  # all border
    assert_empty(extractor(weights).extract(texture(32, 32), np.zeros((32, 32), bool)))


def test_sampling_and_half_precision_leave_keypoints(weights: Path) -> None:
    image = texture(120, 160)
    official = extractor(weights).extract(image)
    exact = extractor(weights, descriptor_sampling="exact").extract(image)
    np.testing.assert_array_equal(exact.keypoints_px, official.keypoints_px)
    cosine = (exact.descriptors * official.descriptors).sum(axis=1)
    assert cosine[official.keypoints_px[:, 0] > 120].mean() < 0.999
    half = extractor(weights, half_precision=True).extract(image)
    assert half.keypoints_px.dtype == half.descriptors.dtype == np.float32
    np.testing.assert_array_equal(half.keypoints_px[:, :2] % 1, 0.5)


def test_the_same_bytes_twice_and_from_a_worker(weights: Path) -> None:
    image = texture(80, 96)
    plugin = extractor(weights)
    sent = pickle.dumps(plugin)
    assert len(sent) < 5000  # no network
    assert pickle.loads(sent).extract(image).descriptors.tobytes() == (
        plugin.extract(image).descriptors.tobytes()
    )


def test_a_second_checkpoint_gives_the_descriptors_and_another_type(
    weights: Path, tmp_path: Path
) -> None:
    image = texture(80, 96)
    tuned = tmp_path / "megadepth.pth"
    state = random_net(1).state_dict()
    torch.save({k: v for k, v in state.items() if not k.startswith("convP")}, tuned)
    plugin = extractor(weights, descriptor_weights=str(tuned))
    alone = extractor(weights)
    assert (alone.name, plugin.name) == ("superpoint", "superpoint-megadepth")
    assert SuperPoint.name == "superpoint"
    assert plugin.weights() == {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in (weights, tuned)
    }
    assert list(alone.weights()) == ["superpoint_v1.pth"]
    found, frozen = plugin.extract(image), alone.extract(image)
    np.testing.assert_array_equal(found.keypoints_px, frozen.keypoints_px)
    whole = tmp_path / "other.pth"
    torch.save({**torch.load(weights, weights_only=True), **state}, whole)
    assert extractor(whole).name == "superpoint-other"
    assert np.abs(found.descriptors - frozen.descriptors).max() > 0.1


def test_the_batch_norm_variant_is_known_by_its_keys(weights: Path, tmp_path: Path) -> None:
    torch.manual_seed(2)
    path = tmp_path / "superpoint_v6_from_tf.pth"
    torch.save(SuperPointBatchNormNet().state_dict(), path)
    image = texture(80, 96)
    plugin = extractor(path)
    assert plugin.name == "superpoint-v6_from_tf"
    official = plugin.extract(image)
    exact = extractor(path, descriptor_sampling="exact").extract(image)
    np.testing.assert_array_equal(official.descriptors, exact.descriptors)
    assert len(official.scores) > 10
    with pytest.raises(OptionError, match="descriptor_weights"):
        extractor(path, descriptor_weights=str(weights)).extract(image)


def test_weights_that_are_missing_or_do_not_fit(tmp_path: Path) -> None:
    with pytest.raises(MeglocError, match="nowhere"):
        extractor(tmp_path / "nowhere.pth")
    path = tmp_path / "wrong.pth"
    torch.save({"conv1a.weight": torch.zeros(64, 1, 3, 3)}, path)
    with pytest.raises(DataError, match=r"wrong\.pth: .*23 missing keys"):
        extractor(path).extract(texture(32, 32))

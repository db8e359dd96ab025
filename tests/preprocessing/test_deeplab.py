"""DeepLabV3+ as a segmenter: its checkpoint, its labels, and sizes beyond the network's."""

from __future__ import annotations

import hashlib
import pickle
import runpy
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from megloc_kapture.errors import DataError
from megloc_kapture.nets.deeplabv3plus import Backbone, DeepLabV3Plus
from megloc_kapture.preprocessing.deeplab import DeepLab, DeepLabOptions

# what make_reference.py of it has written
PUBLISHED = Path(__file__).parent.parent / "nets" / "data" / "deeplabv3plus"


def smooth_noise() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (12, 17, 3), dtype=np.uint8)
    return cv2.resize(noise, (171, 123), interpolation=cv2.INTER_CUBIC)


def checkpoint(path: Path, backbone: Backbone = "mobilenet") -> Path:
    """Random weights in the container they are published in."""
    torch.manual_seed(0)
    network = DeepLabV3Plus(backbone, num_classes=19)
    # statistics of what it sees, without which one class would win everywhere
    for part in network.modules():
        if isinstance(part, torch.nn.BatchNorm2d):
            part.momentum = 1.0
    with torch.no_grad():
        image = torch.from_numpy(smooth_noise()).permute(2, 0, 1)[None].float() / 255
        network.train()(torch.cat([image, 1 - image]))
    torch.save({"cur_itrs": 30000, "model_state": network.state_dict(), "best_score": 0.7}, path)
    return path


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return checkpoint(tmp_path_factory.mktemp("weights") / "mobilenet.pth")


def deeplab(weights: Path, **options: object) -> DeepLab:
    return DeepLab(DeepLabOptions(weights=str(weights), device="cpu", **options))


def test_labels_are_the_published_networks_at_the_images_size(tmp_path: Path) -> None:
    with torch.device("meta"):
        network = DeepLabV3Plus("mobilenet", num_classes=19)
    shapes = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    state = runpy.run_path(str(PUBLISHED / "make_reference.py"))["random_state"](shapes)
    torch.save({"model_state": state, "best_score": 0.7}, tmp_path / "published.pth")
    reference = np.load(PUBLISHED / "reference.npz")
    labels = deeplab(tmp_path / "published.pth").segment(reference["image"])
    assert labels.shape == reference["image"].shape[:2] and labels.dtype == np.uint8
    assert len(np.unique(labels)) > 3
    assert (labels != reference["mobilenet/classes"]).mean() < 1e-3  # but for ties


def test_the_backbone_is_read_from_the_checkpoint(tmp_path: Path) -> None:
    resnet = checkpoint(tmp_path / "any-name.pth", "resnet101")
    labels = deeplab(resnet).segment(smooth_noise()[:64, :80])
    assert labels.shape == (64, 80) and labels.max() < 19
    path = tmp_path / "other.pth"
    torch.save({"model_state": {"conv1a.weight": torch.zeros(64, 1, 3, 3)}}, path)
    with pytest.raises(DataError, match=r"other\.pth: no DeepLabV3\+"):
        deeplab(path).segment(smooth_noise())


def test_a_larger_image_is_made_smaller_and_its_labels_are_not(weights: Path) -> None:
    photograph = smooth_noise()
    large = cv2.resize(photograph, (342, 246), interpolation=cv2.INTER_NEAREST)
    labels = deeplab(weights, max_size_px=171).segment(large)
    assert labels.shape == (246, 342)
    # each pixel of the small image is four equal ones of the large
    small = deeplab(weights).segment(photograph)
    doubled = cv2.resize(small, (342, 246), interpolation=cv2.INTER_NEAREST)
    assert (labels == doubled).mean() > 0.9
    # with all its pixels the network would see other things
    assert (deeplab(weights).segment(large) == doubled).mean() < 0.7


def test_people_and_vehicles_move() -> None:
    assert len(DeepLab.classes) == len(set(DeepLab.classes)) == 19
    # train ids of cityscapesScripts
    assert [DeepLab.classes.index(c) for c in ("road", "sky", "person", "car")] == [0, 10, 11, 13]
    assert DeepLab.dynamic == {
        *("person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle")
    }


def test_it_travels_light_and_names_its_weights(weights: Path) -> None:
    segmenter, image = deeplab(weights), smooth_noise()
    packed = pickle.dumps(segmenter)
    assert len(packed) < 10_000
    assert np.array_equal(pickle.loads(packed).segment(image), segmenter.segment(image))
    checksum = hashlib.sha256(weights.read_bytes()).hexdigest()
    assert segmenter.weights() == {"mobilenet.pth": checksum}

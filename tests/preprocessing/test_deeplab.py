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
from published import published_shapes, shapes_of
from torch.nn import functional as F
from transformers import MobileViTConfig
from transformers.models.mobilevit.modeling_mobilevit import MobileViTASPP

from megloc_kapture.errors import DataError
from megloc_kapture.nets.runtime import load_strictly
from megloc_kapture.preprocessing.deeplab import (
    AtrousPyramid,
    Backbone,
    DeepLab,
    DeepLabOptions,
    DeepLabV3Plus,
    backbone_of,
    most_likely,
)

# what make_reference.py of it has written
PUBLISHED = Path(__file__).parent.parent / "nets" / "data" / "deeplabv3plus"


def smooth_noise() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (12, 17, 3), dtype=np.uint8)
    return cv2.resize(noise, (171, 123), interpolation=cv2.INTER_CUBIC)


def checkpoint(path: Path, backbone: Backbone = "mobilenet") -> Path:
    """Random weights in the container they are published in."""
    torch.manual_seed(0)
    network = DeepLabV3Plus(backbone, num_classes=19)
    # statistics of its input; otherwise one class would win everywhere
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


random_state = runpy.run_path(str(PUBLISHED / "make_reference.py"))["random_state"]


def test_the_backbone_and_the_classes_are_the_files() -> None:
    for backbone in ("resnet101", "mobilenet"):
        assert backbone_of(published_shapes(f"deeplabv3plus-{backbone}"), "w.pth") == backbone
    with pytest.raises(DataError, match=r"w\.pth: not DeepLabV3\+"):
        backbone_of(["conv1a.weight"], "w.pth")
    other_classes = DeepLabV3Plus("mobilenet", num_classes=21)
    state = random_state(published_shapes("deeplabv3plus-mobilenet"))
    with pytest.raises(DataError, match=r"classifier\.classifier\.3\.bias is \(19,\), not \(21,\)"):
        load_strictly(other_classes, state, "w.pth")


@pytest.mark.parametrize("backbone", ["resnet101", "mobilenet"])
def test_logits_and_classes_are_the_authors(backbone: Backbone) -> None:
    outputs = np.load(PUBLISHED / "reference.npz")
    with torch.device("meta"):
        network = DeepLabV3Plus(backbone, num_classes=19)
    state = random_state(published_shapes(f"deeplabv3plus-{backbone}"))
    network.load_state_dict(state, strict=True, assign=True)
    image = torch.from_numpy(outputs["image"]).permute(2, 0, 1)
    with torch.inference_mode():
        logits = network.eval()(image[None] / 255)[0]
    expected = torch.from_numpy(outputs[f"{backbone}/logits"])
    scatter = float(expected.std(dim=(1, 2)).mean())  # among the pixels of a class
    assert scatter > 0.05
    torch.testing.assert_close(logits, expected, rtol=0, atol=1e-4 * scatter)
    classes = most_likely(logits, *image.shape[1:]).numpy()
    assert len(np.unique(classes)) > 5
    assert (classes != outputs[f"{backbone}/classes"]).mean() < 1e-3  # but for ties


@pytest.mark.parametrize("size", [(23, 40), (1, 1)])
def test_the_pyramid_is_transformers_pyramid(size: tuple[int, int]) -> None:
    config = MobileViTConfig(
        neck_hidden_sizes=[8, 16, 8], aspp_out_channels=256, atrous_rates=[6, 12, 18]
    )
    theirs = MobileViTASPP(config).eval()
    ours = AtrousPyramid(16).eval()
    state = random_state(shapes_of(ours))
    load_strictly(ours, state, "random")
    kinds = {"0": "convolution", "1": "normalization"}
    renamed = {}
    for key, value in state.items():
        *branch, layer, word = key.split(".")
        if branch == ["convs", "4"]:  # behind the pooling, which is layer 0
            branch, layer = [*branch, "conv_1x1"], str(int(layer) - 1)
        renamed[".".join([*branch, kinds[layer], word])] = value
    theirs.load_state_dict(renamed, strict=True)
    x = torch.randn(2, 16, *size, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        result, expected = ours(x), theirs(x)
    assert expected.std() > 0.1
    torch.testing.assert_close(result, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("backbone", ["resnet101", "mobilenet"])
def test_logits_are_at_a_quarter_of_any_size(backbone: Backbone) -> None:
    size = (33, 67)
    network = DeepLabV3Plus(backbone, num_classes=19).eval()
    with torch.inference_mode():
        logits = network(torch.rand(1, 3, *size))
    # the first convolution of this MobileNetV2 has no padding: two pixels less
    lost = 2 if backbone == "mobilenet" else 0
    expected = [(length - lost + 3) // 4 for length in size]
    assert logits.shape == (1, 19, *expected)
    assert torch.isfinite(logits).all()


@pytest.mark.parametrize("size", [(40, 60), (37, 53), (9, 200)])
def test_classes_equal_the_argmax_at_full_size(size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    logits = torch.randn(19, 10, 14)
    logits[7] = logits[3]  # equal everywhere: the first counts
    whole = F.interpolate(logits[None], size=size, mode="bilinear", align_corners=False)[0]
    result = most_likely(logits, *size)
    assert result.dtype == torch.uint8
    assert torch.equal(result.long(), whole.argmax(dim=0))
    assert (result == 3).any() and not (result == 7).any()

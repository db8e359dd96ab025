"""DeepLabV3+ against stored outputs of the published network and transformers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from published import published_shapes, random_state
from torch.nn import functional as F

from megloc_kapture.errors import DataError
from megloc_kapture.preprocessing import deeplab as module
from megloc_kapture.preprocessing.deeplab import (
    Backbone,
    DeepLab,
    DeepLabOptions,
    DeepLabV3Plus,
    backbone_of,
    most_likely,
)

# written by make_reference.py in the same folder
PUBLISHED = Path(__file__).parent.parent / "nets" / "data" / "deeplabv3plus"


def deeplab(weights: Path) -> DeepLab:
    return DeepLab(DeepLabOptions(weights=str(weights), device="cpu"))


def test_labels_equal_the_published_network_at_the_size_of_the_image(tmp_path: Path) -> None:
    state = random_state(published_shapes("deeplabv3plus-mobilenet"))
    torch.save({"model_state": state, "best_score": 0.7}, tmp_path / "published.pth")
    reference = np.load(PUBLISHED / "reference.npz")
    labels = deeplab(tmp_path / "published.pth").segment(reference["image"])
    assert labels.shape == reference["image"].shape[:2] and labels.dtype == np.uint8
    assert len(np.unique(labels)) > 3
    assert (labels != reference["mobilenet/classes"]).mean() < 1e-3  # ties


def test_a_large_image_is_reduced_before_the_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def classes_by_brightness(image: torch.Tensor) -> torch.Tensor:
        assert image.shape == (1, 3, 40, 64)
        return torch.cat([image[:, :1], 1 - image[:, :1]], dim=1)

    network = classes_by_brightness, torch.device("cpu")
    monkeypatch.setattr(DeepLab, "network", lambda *_: network)
    monkeypatch.setattr(module, "_MAX_SIZE_PX", 64)
    (tmp_path / "any.pth").touch()
    image = np.zeros((80, 128, 3), np.uint8)
    image[:, 50:] = 255
    labels = deeplab(tmp_path / "any.pth").segment(image)
    assert labels.shape == (80, 128)
    assert (labels[:, :48] == 1).all() and (labels[:, 52:] == 0).all()


def test_people_and_vehicles_are_dynamic() -> None:
    assert len(DeepLab.classes) == len(set(DeepLab.classes)) == 19
    # train ids of cityscapesScripts
    assert [DeepLab.classes.index(c) for c in ("road", "sky", "person", "car")] == [0, 10, 11, 13]
    assert DeepLab.dynamic == {
        *("person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle")
    }


def test_the_backbone_is_recognised_by_the_keys() -> None:
    for backbone in ("resnet101", "mobilenet"):
        assert backbone_of(published_shapes(f"deeplabv3plus-{backbone}"), "w.pth") == backbone
    with pytest.raises(DataError, match=r"w\.pth: this file is not a DeepLabV3\+"):
        backbone_of(["conv1a.weight"], "w.pth")


@pytest.mark.parametrize("backbone", ["resnet101", "mobilenet"])
def test_logits_and_classes_equal_the_published_network(backbone: Backbone) -> None:
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


@pytest.mark.parametrize("size", [(40, 60), (9, 200)])
def test_classes_equal_the_argmax_at_full_size(size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    logits = torch.randn(19, 10, 14)
    logits[7] = logits[3]  # the first of equal classes counts
    whole = F.interpolate(logits[None], size=size, mode="bilinear", align_corners=False)[0]
    result = most_likely(logits, *size)
    assert result.dtype == torch.uint8
    assert torch.equal(result.long(), whole.argmax(dim=0))
    assert (result == 3).any() and not (result == 7).any()

"""The plugin lpips: its weights and names, and the network's answer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.localization.lpips import LpipsDistance, LpipsOptions
from megloc_kapture.nets.lpips import Lpips
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import IMAGE_DISTANCES


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Random weights of SqueezeNet's layout, as a trunk's file and one of heads."""
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    state = {key: value.abs() * 0.3 for key, value in Lpips("squeeze").state_dict().items()}
    trunk = {key: value for key, value in state.items() if key.startswith("features.")}
    torch.save(trunk, folder / "trunk.pth")
    torch.save({key: state[key] for key in state.keys() - trunk.keys()}, folder / "heads.pth")
    return folder / "trunk.pth", folder / "heads.pth"


def distance(files: tuple[Path, Path], **options: object) -> Any:
    trunk, heads = map(str, files)
    given = {"net": "squeeze", "trunk": trunk, "heads": heads, "device": "cpu", **options}
    return load_plugin(IMAGE_DISTANCES, "lpips", given)


def pictures(count: int = 2, height: int = 80) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (count, height, 96, 3), dtype=np.uint8)


FULL = np.ones((80, 96), bool)


def test_the_distance_equals_the_networks(files: tuple[Path, Path]) -> None:
    plugin = distance(files)
    assert isinstance(plugin, LpipsDistance)
    assert sorted(plugin.weights()) == ["heads.pth", "trunk.pth"]
    a, b = pictures()
    valid = FULL.copy()
    valid[:, :30] = False
    net = Lpips("squeeze")
    net.load_state_dict({k: v for f in files for k, v in torch.load(f, weights_only=True).items()})
    tensors = [torch.from_numpy(x.transpose(2, 0, 1)[None] / 255.0).float() for x in (a, b)]
    with torch.inference_mode():
        expected = float(net(*tensors, torch.from_numpy(valid)[None, None].float())[0])
    assert expected > 0
    assert plugin.distance(a, b, valid) == pytest.approx(expected, rel=1e-5)
    assert plugin.distance(a, a, valid) == 0.0
    half = distance(files, half_precision=True).distance(a, b, FULL)
    assert half == pytest.approx(plugin.distance(a, b, FULL), rel=0.1)


def test_the_distance_without_valid_pixels_is_infinite(files: tuple[Path, Path]) -> None:
    assert distance(files).distance(*pictures(), ~FULL) == np.inf
    assert distance(files).distance(*pictures(height=40), FULL[:40]) == np.inf


def test_missing_and_mismatched_weights_are_named(files: tuple[Path, Path]) -> None:
    with pytest.raises(MissingWeightsError, match="lpips-trunk-vgg"):
        LpipsDistance(LpipsOptions.model_validate({"net": "vgg"}))
    with pytest.raises(DataError, match=r"features\.0\.weight"):
        distance(files, net="alex").distance(*pictures(), FULL)

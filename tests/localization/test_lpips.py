"""The plugin lpips: its weights and names, and the network's answer."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.localization.lpips import LpipsDistance, LpipsOptions
from megloc_kapture.nets.lpips import Lpips
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import IMAGE_DISTANCES, ImageDistance


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


def distance(files: tuple[Path, Path], **options: object) -> LpipsDistance:
    trunk, heads = (str(file) for file in files)
    return LpipsDistance(
        LpipsOptions.model_validate(
            {"net": "squeeze", "trunk": trunk, "heads": heads, "device": "cpu", **options}
        )
    )


def pictures(height: int = 80, width: int = 96) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return tuple(rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(2))


def test_it_is_the_networks_distance(files: tuple[Path, Path]) -> None:
    plugin = distance(files)
    assert isinstance(plugin, ImageDistance)
    assert plugin.name == "lpips-like-squeeze"
    assert sorted(plugin.weights()) == ["heads.pth", "trunk.pth"]
    a, b = pictures()
    valid = np.ones(a.shape[:2], bool)
    valid[:, :30] = False
    net = Lpips("squeeze")
    net.load_state_dict({k: v for f in files for k, v in torch.load(f, weights_only=True).items()})
    with torch.inference_mode():
        tensors = [torch.from_numpy(x.transpose(2, 0, 1)[None] / 255.0).float() for x in (a, b)]
        expected = float(net(*tensors, torch.from_numpy(valid)[None, None].float())[0])
    assert expected > 0
    assert plugin.distance(a, b, valid) == pytest.approx(expected, rel=1e-5)
    assert plugin.distance(a, a, valid) == 0.0
    again = pickle.loads(pickle.dumps(plugin))
    assert again.distance(a, b, valid) == plugin.distance(a, b, valid)


def test_it_is_found_by_its_name(files: tuple[Path, Path]) -> None:
    trunk, heads = (str(file) for file in files)
    options = {"net": "squeeze", "trunk": trunk, "heads": heads}
    assert isinstance(load_plugin(IMAGE_DISTANCES, "lpips", options), LpipsDistance)


def masks(height: int = 80, width: int = 96) -> list[np.ndarray]:
    """A full one, one without the left, one without a patch."""
    found = np.ones((3, height, width), bool)
    found[1, :, :40] = False
    found[2, 20:50, 30:70] = False
    return list(found)


def test_a_query_is_paid_for_once_per_mask(
    files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[torch.Tensor] = []
    described = Lpips.described

    def counted(self: Lpips, image: torch.Tensor, valid: torch.Tensor) -> list[torch.Tensor]:
        seen.append(image)
        return described(self, image, valid)

    monkeypatch.setattr(Lpips, "described", counted)
    plugin = distance(files)
    rng = np.random.default_rng(1)
    query, *views = rng.integers(0, 256, (4, 80, 96, 3), dtype=np.uint8)
    for valid in masks():
        for view in views:
            plugin.distance(query.copy(), view, valid.copy())
    assert len(seen) == 3 * (1 + 3)


def test_what_is_kept_changes_nothing(files: tuple[Path, Path]) -> None:
    plugin = distance(files)
    rng = np.random.default_rng(2)
    query, *views = rng.integers(0, 256, (4, 80, 96, 3), dtype=np.uint8)
    net = Lpips("squeeze")
    net.load_state_dict({k: v for f in files for k, v in torch.load(f, weights_only=True).items()})

    def anew(a: np.ndarray, b: np.ndarray, valid: np.ndarray) -> float:
        tensors = [torch.from_numpy(x.transpose(2, 0, 1)[None] / 255.0).float() for x in (a, b)]
        with torch.inference_mode():
            return float(net(*tensors, torch.from_numpy(valid)[None, None].float())[0])

    # the same array with other pixels is another image
    for shade in (0, 90):
        query[:40] = shade
        for valid in masks():
            for view in views:
                expected = anew(query, view, valid)
                assert plugin.distance(query, view, valid) == pytest.approx(expected, abs=1e-6)


def test_half_precision_is_near(files: tuple[Path, Path]) -> None:
    a, b = pictures()
    valid = np.ones(a.shape[:2], bool)
    half = distance(files, half_precision=True).distance(a, b, valid)
    assert half == pytest.approx(distance(files).distance(a, b, valid), rel=0.1)


def test_where_nothing_can_be_told_it_is_infinite(files: tuple[Path, Path]) -> None:
    a, b = pictures()
    assert distance(files).distance(a, b, np.zeros(a.shape[:2], bool)) == np.inf
    a, b = pictures(40, 96)
    assert distance(files).distance(a, b, np.ones((40, 96), bool)) == np.inf


@pytest.mark.parametrize("net", ["alex", "vgg", "squeeze"])
def test_missing_weights_are_named(net: str) -> None:
    with pytest.raises(MissingWeightsError, match=f"lpips-trunk-{net}"):
        LpipsDistance(LpipsOptions.model_validate({"net": net}))


def test_another_networks_trunk_is_refused(files: tuple[Path, Path]) -> None:
    a, b = pictures()
    with pytest.raises(DataError, match=r"features\.0\.weight"):
        distance(files, net="alex").distance(a, b, np.ones(a.shape[:2], bool))

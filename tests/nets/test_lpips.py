"""LPIPS against the package of its authors, and its checkpoints."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from published import random_state, randomised, shapes_of
from torch import nn

from megloc_kapture.errors import DataError
from megloc_kapture.nets.lpips import Lpips, Trunk, lpips_from

TRUNKS: tuple[Trunk, ...] = ("alex", "vgg", "squeeze")
# of lpips 0.1.4 with torchvision 0.28, for the weights and images of the first test
DISTANCES = {"alex": 0.25598073, "vgg": 0.19636841, "squeeze": 0.21886828}
TAPS = {
    "alex": {1: 64, 4: 192, 7: 384, 9: 256, 11: 256},
    "vgg": {3: 64, 8: 128, 15: 256, 22: 512, 29: 512},
    "squeeze": {1: 64, 4: 128, 7: 256, 9: 384, 10: 384, 11: 512, 12: 512},
}
# of the trunks without their classifiers
NUM_VALUES = {"alex": 2469696, "vgg": 14714688, "squeeze": 722496}
SIZE = (40, 48)


def random_lpips(trunk: Trunk, seed: int = 0) -> Lpips:
    """Activations neither vanish nor explode; heads at least 0."""
    net = randomised(Lpips(trunk), seed)
    for name, value in net.named_parameters():
        if name.startswith("lin"):
            nn.init.uniform_(value, 0.0, 1.0)
    return net


@pytest.fixture(scope="module", params=TRUNKS)
def trunk(request: pytest.FixtureRequest) -> Trunk:
    return request.param


def pictures(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    a, b = torch.rand(2, 1, 3, *SIZE, generator=generator)
    return a, b


def distance(net: Lpips, a: torch.Tensor, b: torch.Tensor, valid: torch.Tensor | None = None):
    if valid is None:
        valid = torch.ones(1, 1, *a.shape[-2:])
    with torch.inference_mode():
        return float(net(a, b, valid)[0])


def test_the_distance_equals_that_of_the_authors_package(trunk: Trunk) -> None:
    net = Lpips(trunk).eval()
    weights = random_state(shapes_of(net))
    # the published heads have no negative weights
    net.load_state_dict({k: v.abs() if k.startswith("lin") else v for k, v in weights.items()})
    bits = np.random.PCG64(0).random_raw(2 * 3 * 72 * 80) >> 56
    a, b = torch.from_numpy(bits.astype(np.uint8).reshape(2, 1, 3, 72, 80)).float() / 255
    assert distance(net, a, b) == pytest.approx(DISTANCES[trunk], rel=1e-4)


def test_keys_and_sizes_equal_the_published_files(trunk: Trunk) -> None:
    state = Lpips(trunk).state_dict()
    heads = {key: tuple(value.shape) for key, value in state.items() if key.startswith("lin")}
    assert heads == {
        f"lin{k}.model.1.weight": (1, channels, 1, 1)
        for k, channels in enumerate(TAPS[trunk].values())
    }
    features = [value.numel() for key, value in state.items() if key.startswith("features.")]
    assert sum(features) == NUM_VALUES[trunk]
    assert len(features) + len(heads) == len(state)


def test_only_valid_pixels_count() -> None:
    net = random_lpips("alex")
    a, b = pictures(3)
    assert distance(net, a, a) == 0.0 < distance(net, a, b)
    assert distance(net, a, b) == pytest.approx(distance(net, b, a), rel=1e-5)
    valid = torch.ones(1, 1, *SIZE)
    valid[..., :20, :] = 0
    changed = b.clone()
    changed[..., :20, :] = torch.rand(3, 20, SIZE[1])
    assert distance(net, a, changed, valid) == distance(net, a, b, valid)
    assert distance(net, a, changed) != distance(net, a, b)
    # the mean is over valid pixels
    zeros = [torch.zeros(1, channels, 8, 8) for channels in TAPS["alex"].values()]
    ones = [x + 1 for x in zeros]
    means = [net.between(zeros, ones, mask) for mask in (valid, torch.ones_like(valid))]
    torch.testing.assert_close(*means)


def test_checkpoints_load_strictly() -> None:
    net = random_lpips("squeeze")
    state = dict(net.state_dict())
    heads = {key: state.pop(key) for key in list(state) if key.startswith("lin")}
    # torchvision's files also hold a classifier
    trunk = {**state, "classifier.1.weight": torch.zeros(3)}
    a, b = pictures(5)
    assert distance(lpips_from("squeeze", trunk, heads, "file"), a, b) == distance(net, a, b)
    with pytest.raises(DataError, match=r"lin0\.model\.1\.weight"):
        lpips_from("squeeze", trunk, {**heads, "lin0.model.1.weight": torch.zeros(1, 9)}, "file")

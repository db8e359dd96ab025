"""LPIPS against the published formula, and its checkpoints."""

from __future__ import annotations

import pytest
import torch
from published import randomised
from torch import nn
from torch.nn import functional as F

from megloc_kapture.errors import DataError
from megloc_kapture.nets.lpips import Lpips, Trunk, lpips_from

TRUNKS: tuple[Trunk, ...] = ("alex", "vgg", "squeeze")
# torchvision's layers, as (kind, numbers), from the published tables
ALEX = [
    *(("conv", 0, 4, 2), ("relu",), ("pool", False), ("conv", 3, 1, 2), ("relu",), ("pool", False)),
    *(("conv", 6, 1, 1), ("relu",), ("conv", 8, 1, 1), ("relu",), ("conv", 10, 1, 1), ("relu",)),
]
SQUEEZE = [
    *(("conv", 0, 2, 0), ("relu",), ("pool", True), ("fire", 3), ("fire", 4), ("pool", True)),
    *(("fire", 6), ("fire", 7), ("pool", True), ("fire", 9), ("fire", 10), ("fire", 11)),
    ("fire", 12),
]
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


@pytest.fixture(scope="module")
def net(trunk: Trunk) -> Lpips:
    return random_lpips(trunk)


def pictures(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    a, b = torch.rand(2, 1, 3, *SIZE, generator=generator)
    return a, b


def functional_trunk(
    kind: Trunk, state: dict[str, torch.Tensor], x: torch.Tensor
) -> list[torch.Tensor]:
    """Activations at the taps, out of a state dict by torch's functions alone."""

    def conv(name: str, x: torch.Tensor, stride: int = 1, border: int = 0) -> torch.Tensor:
        return F.conv2d(
            x, state[f"{name}.weight"], state[f"{name}.bias"], stride=stride, padding=border
        )

    layers: list[tuple] = {"alex": ALEX, "squeeze": SQUEEZE, "vgg": []}[kind]
    if kind == "vgg":
        for number in range(30):
            pools, convolves = number in (4, 9, 16, 23), f"features.{number}.weight" in state
            layers.append(
                ("pool2",) if pools else ("conv", number, 1, 1) if convolves else ("relu",)
            )
    result = []
    for number, (what, *how) in enumerate(layers):
        if what == "conv":
            x = conv(f"features.{how[0]}", x, how[1], how[2])
        elif what == "relu":
            x = x.clamp(min=0)
        elif what == "pool":
            x = F.max_pool2d(x, 3, stride=2, ceil_mode=how[0])
        elif what == "pool2":
            x = F.max_pool2d(x, 2)
        else:
            at = f"features.{how[0]}"
            x = conv(f"{at}.squeeze", x).clamp(min=0)
            halves = [conv(f"{at}.expand1x1", x), conv(f"{at}.expand3x3", x, border=1)]
            x = torch.cat(halves, dim=1).clamp(min=0)
        if number in TAPS[kind]:
            result.append(x)
    return result


def by_formula(kind: Trunk, state: dict[str, torch.Tensor], a: torch.Tensor, b: torch.Tensor):
    """Eq. 1: sum over layers, mean over pixels, of || w * (y - y0) ||^2, with w^2 the heads."""
    shift, scale = torch.tensor([[-0.030, -0.088, -0.188], [0.458, 0.448, 0.450]]).double()
    total = 0.0
    with torch.inference_mode():
        taps = [
            functional_trunk(
                kind,
                state,
                ((2 * x.double() - 1 - shift[:, None, None]) / scale[:, None, None]).float(),
            )
            for x in (a, b)
        ]
    for layer, (y, y0) in enumerate(zip(*taps, strict=True)):
        weights = state[f"lin{layer}.model.1.weight"].double()
        difference = F.normalize(y.double(), dim=1) - F.normalize(y0.double(), dim=1)
        total += float((weights * difference**2).sum(1).mean())
    return total


def distance(net: Lpips, a: torch.Tensor, b: torch.Tensor, valid: torch.Tensor | None = None):
    if valid is None:
        valid = torch.ones(1, 1, *a.shape[-2:])
    with torch.inference_mode():
        return float(net(a, b, valid)[0])


def test_the_distance_equals_the_published_formula(net: Lpips, trunk: Trunk) -> None:
    a, b = pictures(1)
    expected = by_formula(trunk, net.state_dict(), a, b)
    assert expected > 0.01
    assert distance(net, a, b) == pytest.approx(expected, rel=1e-4)


def test_keys_and_sizes_equal_the_published_files(net: Lpips, trunk: Trunk) -> None:
    state = net.state_dict()
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

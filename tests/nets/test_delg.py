"""DELG's two networks against TensorFlow, and their parts against plain restatements."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.nn import functional

from megloc_kapture.errors import DataError
from megloc_kapture.nets.delg import DelgNet, Form, delg_from, delg_state, describe

# written by TensorFlow, see make_reference.py there
WRITTEN = Path(__file__).parent / "data" / "delg"
SCALES = (0.70710677, 1.0, 1.4142135)
ENDING = "/.ATTRIBUTES/VARIABLE_VALUE"
WORDS = ("kernel", "bias", "gamma", "beta", "moving_mean", "moving_variance")
Tensors = dict[str, torch.Tensor]


def shapes_of(kind: str) -> dict[str, tuple[int, ...]]:
    """Name -> shape of the variables, as TensorFlow wrote them."""
    rows = (row.split() for row in (WRITTEN / f"{kind}.txt").read_text().splitlines())
    return {name: () if s == "scalar" else tuple(map(int, s.split("x"))) for name, s in rows}


def values_of(name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """As make_reference.py has it."""
    random = np.random.RandomState(zlib.crc32(name.encode()))
    if len(shape) > 1:
        deviation = np.sqrt(2 / np.prod(shape[:-1]))
        return (random.standard_normal(shape) * deviation).astype(np.float32)
    word = name.removesuffix(ENDING).rpartition("/")[2]
    word = WORDS[int(word) % 6] if word.isdigit() else word
    low, high = {"moving_variance": (0.5, 2.0), "gamma": (0.3, 0.7)}.get(word, (-0.2, 0.2))
    return random.uniform(low, high, shape).astype(np.float32)


def image() -> NDArray[np.uint8]:
    return np.random.RandomState(0).randint(0, 256, (101, 134, 3)).astype(np.uint8)


@pytest.fixture(scope="module", params=["keras", "slim"])
def form(request: pytest.FixtureRequest) -> Form:
    return request.param


@pytest.fixture(scope="module")
def net(form: Form) -> DelgNet:
    tensors = {
        name: torch.from_numpy(np.asarray(values_of(name, shape)))
        for name, shape in shapes_of(form).items()
    }
    return delg_from(tensors, "x.index")


def empty(kind: str) -> Tensors:
    return {name: torch.empty(shape, device="meta") for name, shape in shapes_of(kind).items()}


def test_vectors_are_tensorflows(net: DelgNet, form: Form) -> None:
    with np.load(WRITTEN / "reference.npz") as written:
        expected = written[form]
    pixels = torch.from_numpy(image()).permute(2, 0, 1)[None].float()
    sizes = [(71, 95), (101, 134), (143, 190)]
    with torch.inference_mode():
        for size, vector in zip(sizes, expected, strict=True):
            seen = functional.interpolate((pixels - 128) / 128, size, mode="bilinear")
            np.testing.assert_allclose(net(seen)[0].numpy(), vector, atol=2e-5)
        found = describe(net, pixels, SCALES)[0].numpy()
    units = expected / np.linalg.norm(expected, axis=1, keepdims=True)
    joined = units.sum(axis=0) / np.linalg.norm(units.sum(axis=0))
    np.testing.assert_allclose(found, joined, atol=1e-6)
    # the comparison tells scales apart
    assert np.abs(joined - units[1]).max() > 1e-4
    assert np.linalg.norm(found) == pytest.approx(1)


def restated(state: Tensors, image: torch.Tensor) -> torch.Tensor:
    """The public training code's ResNet-50, as a chain of functions."""

    def normed(x: torch.Tensor, name: str) -> torch.Tensor:
        mean, variance = state[f"{name}.running_mean"], state[f"{name}.running_var"]
        scale = state[f"{name}.weight"] / (variance + 1e-3).sqrt()
        shift = state[f"{name}.bias"] - mean * scale
        return x * scale[:, None, None] + shift[:, None, None]

    def conv(x: torch.Tensor, name: str, **how: Any) -> torch.Tensor:
        return functional.conv2d(x, state[f"{name}.weight"], state[f"{name}.bias"], **how)

    # SAME: of 7 pixels at stride 2, an even side needs 2 and 3 more, an odd one 3 and 3
    (top, left), (bottom, right) = ((2 if n % 2 == 0 else 3 for n in image.shape[2:]), (3, 3))
    x = conv(functional.pad(image, (left, right, top, bottom)), "conv1", stride=2)
    x = functional.max_pool2d(normed(x, "bn1").relu(), 3, 2, padding=0)
    for stage, blocks in enumerate((3, 4, 6, 3), 1):
        for block in range(blocks):
            place = f"layer{stage}.{block}."
            stride = 2 if stage > 1 and block == 0 else 1
            y = normed(conv(x, place + "conv1", stride=stride), place + "bn1").relu()
            y = normed(conv(y, place + "conv2", padding=1), place + "bn2").relu()
            y = normed(conv(y, place + "conv3"), place + "bn3")
            if block == 0:
                shortcut = conv(x, place + "downsample.0", stride=stride)
                x = normed(shortcut, place + "downsample.1")
            x = (x + y).relu()
    pooled = x.clamp(min=1e-6).pow(3).mean(dim=(2, 3)).pow(1 / 3)
    return pooled @ state["embedding.weight"].T + state["embedding.bias"]


@pytest.mark.parametrize("form", ["keras"], indirect=True)
@pytest.mark.parametrize("size", [(64, 64), (65, 98), (70, 67)])
def test_keras_form_is_a_plain_chain(net: DelgNet, size: tuple[int, int]) -> None:
    x = torch.rand(2, 3, *size, generator=torch.manual_seed(0)) * 2 - 1
    with torch.inference_mode():
        expected = restated(dict(net.state_dict()), x)
        torch.testing.assert_close(net(x), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("side", range(5, 40))
def test_sizes_after_the_first_layers(side: int) -> None:
    halves = -(-side // 2)
    with torch.device("meta"):
        keras, slim = DelgNet(50, "keras"), DelgNet(50, "slim")
        x = torch.zeros(1, 3, side, 64)
        # VALID: what does not fill a window is left out; SAME: nothing is
        assert keras._stem(x).shape == (1, 64, (halves - 3) // 2 + 1, 15)
        assert slim._stem(x).shape == (1, 64, -(-halves // 2), 16)


def test_number_of_weights() -> None:
    # ResNet without classifier (He et al.), and a layer of 2048 x 2048 with bias
    heads = 2048 * 2048 + 2048
    for depth, trunk in ((50, 23_508_032), (101, 42_500_160)):
        with torch.device("meta"):
            slim, keras = DelgNet(depth, "slim"), DelgNet(depth, "keras")
        assert sum(p.numel() for p in slim.parameters()) == trunk + heads
        # a bias for each channel that has a norm
        more = sum(p.numel() for name, p in keras.named_parameters() if "bn" in name) // 2
        more += 256 + 512 + 1024 + 2048
        assert sum(p.numel() for p in keras.parameters()) == trunk + heads + more


def test_preprocessing_by_hand() -> None:
    seen = []

    class Watching(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            seen.append(x)
            return torch.ones(len(x), 2048)

    pixels = torch.tensor([[0.0, 128, 255, 64, 32, 16]]).expand(1, 3, 5, 6)
    describe(Watching(), pixels, (1.0, 2.0))  # type: ignore[arg-type]
    assert seen[0][0, 0, 0].tolist() == [-1, 0, 127 / 128, -0.5, -0.75, -0.875]
    # half-pixel centres: new places stand a quarter beside the old ones
    row = seen[1][0, 0, 0].tolist()
    assert seen[1].shape == (1, 3, 10, 12)
    assert row[:4] == pytest.approx([-1, -0.75, -0.25, 127 / 128 / 4])


def test_sides_are_rounded_as_tensorflow_does() -> None:
    sizes = []

    class Watching(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            sizes.append(tuple(x.shape[2:]))
            return torch.ones(len(x), 2048)

    describe(Watching(), torch.zeros(1, 3, 13, 15), (0.5,))  # type: ignore[arg-type]
    assert sizes == [(6, 8)]  # 6.5 and 7.5, each to the even one


def test_too_small_an_image() -> None:
    with torch.device("meta"):
        net = DelgNet(50, "keras")
    with pytest.raises(DataError, match=r"an image of 40 x 6 pixels is too small .* at scale 0\.7"):
        describe(net, torch.zeros(1, 3, 6, 40), SCALES)


@pytest.mark.parametrize("kind", ["keras", "keras-weights", "slim"])
def test_every_variable_of_the_global_branch_has_its_key(kind: str) -> None:
    form, state = delg_state(empty(kind), "x.index")
    assert form == kind.partition("-")[0]
    with torch.device("meta"):
        expected = DelgNet(50, form).state_dict()
    counters = {key for key in expected if key.endswith("num_batches_tracked")}
    assert set(state) == set(expected) - counters
    assert all(state[key].shape == expected[key].shape for key in state)


@pytest.mark.parametrize("scope", ["", "DELG/backbone/"])
def test_names_of_layers(scope: str) -> None:
    """The same variables under the names that the public code gives its layers."""
    objects = empty("keras-weights")
    named = {}
    for name, values in objects.items():
        parts = name.removesuffix(ENDING).split("/")
        if parts[0] != "backbone":
            continue
        if len(parts) == 4:
            place, layer, word = parts[1][1:], parts[2], parts[3]
            kind = "bn" if layer.startswith("bn") else "res"
            branch = "1" if layer.endswith("shortcut") else layer[-2:]
            named[f"{scope}{kind}{place}_branch{branch}/{word}"] = values
        else:
            named[f"{scope}{'/'.join(parts[1:])}"] = values
    named["DELG/attention/bn_conv1/gamma"] = torch.empty(512)
    form, state = delg_state(named, "x.index")
    assert form == "keras"
    assert state.keys() == delg_state(objects, "x.index")[1].keys()


def test_layouts_and_places() -> None:
    tensors = empty("keras-weights")
    kernel = torch.rand(1, 1, 256, 128)
    tensors[f"backbone/l3a/conv2a/kernel{ENDING}"] = kernel
    dense = torch.rand(2048, 2048)
    tensors[f"backbone/embedding_layer/kernel{ENDING}"] = dense
    variance = torch.rand(1024)
    tensors[f"backbone/l4a/bn_shortcut/moving_variance{ENDING}"] = variance
    _, state = delg_state(tensors, "x.index")
    assert torch.equal(state["layer2.0.conv1.weight"][5, 7], kernel[:, :, 7, 5])
    assert torch.equal(state["embedding.weight"], dense.T)
    assert torch.equal(state["layer3.0.downsample.1.running_var"], variance)


def test_checkpoints_that_do_not_fit() -> None:
    with pytest.raises(DataError, match=r"^x\.index: no DELG whose .*found: a/b, c and|found: a/b"):
        delg_state({"a/b": torch.zeros(1), "c": torch.zeros(1)}, "x.index")
    slim = empty("slim")
    slim["other/weights"], slim["other/biases"] = torch.empty(2048, 2048), torch.empty(2048)
    with pytest.raises(DataError, match="there is .*other.*whitening|there is .*whitening.*other"):
        delg_state(slim, "x.index")
    headless = {name: v for name, v in empty("slim").items() if "whitening" not in name}
    with pytest.raises(DataError, match="2048 x 2048 weights .*there is none"):
        delg_state(headless, "x.index")
    short = {name: v for name, v in empty("keras-weights").items() if "/l4f/" not in name}
    with pytest.raises(DataError, match="5 blocks in the third stage, not 6 "):
        delg_from(short, "x.index")
    lost = empty("keras-weights")
    del lost[f"backbone/l2a/bn2b/gamma{ENDING}"]
    with pytest.raises(DataError, match=r"1 missing keys: layer1\.0\.bn2\.weight"):
        delg_from(lost, "x.index")
    twice = empty("keras-weights")
    twice[f"other/backbone/conv1/kernel{ENDING}"] = torch.empty(7, 7, 3, 64)
    with pytest.raises(DataError, match=r"conv1\.weight is in it twice"):
        delg_state(twice, "x.index")

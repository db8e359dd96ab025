"""DELG's two networks against TensorFlow, and the names of their variables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from convert_weights import delg_state
from published import delg_shapes, delg_variables

from megloc_kapture.errors import DataError
from megloc_kapture.nets.delg import DelgNet, Form, delg_from

# written by TensorFlow, see data/README.md
REFERENCE = Path(__file__).parent / "data" / "delg" / "reference.npz"
SCALES = (0.70710677, 1.0, 1.4142135)
ENDING = "/.ATTRIBUTES/VARIABLE_VALUE"


@pytest.fixture(scope="module", params=["keras", "slim"])
def form(request: pytest.FixtureRequest) -> Form:
    return request.param


@pytest.fixture(scope="module")
def net(form: Form) -> DelgNet:
    return delg_from(delg_state(delg_variables(form)), "x.safetensors", SCALES)


def empty(kind: str) -> dict[str, np.ndarray]:
    """Zeros of the published shapes, without their memory."""
    return {name: np.broadcast_to(np.float32(0), s) for name, s in delg_shapes(kind).items()}


def test_vectors_equal_tensorflow(net: DelgNet, form: Form) -> None:
    with np.load(REFERENCE) as written:
        expected = written[form]
    image = np.random.RandomState(0).randint(0, 256, (101, 134, 3)).astype(np.uint8)
    pixels = torch.from_numpy(image).permute(2, 0, 1)[None].float()
    with torch.inference_mode():
        unscaled = net.at_one_scale((pixels - 128) / 128)[0].numpy()
        np.testing.assert_allclose(unscaled, expected[1], atol=2e-5)
        result = net(pixels)[0].numpy()
    units = expected / np.linalg.norm(expected, axis=1, keepdims=True)
    joined = units.sum(axis=0) / np.linalg.norm(units.sum(axis=0))
    np.testing.assert_allclose(result, joined, atol=1e-6)
    assert np.abs(joined - units[1]).max() > 1e-4


def test_an_image_too_small_for_the_smallest_scale_is_refused() -> None:
    with torch.device("meta"):
        net = DelgNet(50, "keras", SCALES)
    with pytest.raises(DataError, match=r"an image of 40 x 6 pixels is too small .* at scale 0\.7"):
        net(torch.zeros(1, 3, 6, 40))


@pytest.mark.parametrize("kind", ["keras", "keras-weights", "slim"])
def test_every_variable_of_the_global_branch_has_its_key(kind: str) -> None:
    state = delg_state(empty(kind))
    form: Form = "slim" if kind == "slim" else "keras"
    with torch.device("meta"):
        expected = DelgNet(50, form).state_dict()
    counters = {key for key in expected if key.endswith("num_batches_tracked")}
    assert set(state) == set(expected) - counters
    assert all(state[key].shape == expected[key].shape for key in state)


def test_variables_named_by_layer_have_the_same_keys() -> None:
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
            named[f"DELG/backbone/{kind}{place}_branch{branch}/{word}"] = values
        else:
            named[f"DELG/backbone/{'/'.join(parts[1:])}"] = values
    assert delg_state(named).keys() == delg_state(objects).keys()


@pytest.mark.parametrize(
    ("kind", "lost", "more", "message"),
    [
        ("slim", "/", {"a/b": ()}, "no variables with a known name of DELG's; found: a/b"),
        ("slim", "whitening", {}, "2048 x 2048 with a bias expected"),
        ("keras-weights", "/l4f/", {}, "5 blocks in the third stage, not 6 "),
        ("keras-weights", "backbone/l2a/bn2b/gamma", {}, r"1 missing keys: layer1\.0\.bn2\.weight"),
    ],
    ids=["another network", "no head", "a block less", "a key less"],
)
def test_other_checkpoints_are_refused(kind: str, lost: str, more: Any, message: str) -> None:
    tensors = {name: values for name, values in empty(kind).items() if lost not in name}
    tensors |= {name: np.empty(shape) for name, shape in more.items()}
    with pytest.raises(DataError, match=message):
        delg_from(delg_state(tensors), "x.safetensors")

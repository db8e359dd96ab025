"""The variables of DELG's TensorFlow checkpoints under the keys of our network.

Three ways of naming are known, and any scope may stand before them:

    objects   backbone/l2a/conv2a/kernel, backbone/l2a/bn_shortcut/gamma,
              backbone/embedding_layer/kernel: attributes of the objects of the public training
              code, each before ``/.ATTRIBUTES/VARIABLE_VALUE``. In an exported model the variables
              of a block may have numbers: backbone/l2a/variables/0 to 17, or 23 with a shortcut
    layers    res2a_branch2a/kernel, bn2a_branch1/gamma, embedding_layer/kernel: the same layers by
              their names, as a graph of TF1 has them
    slim      resnet_v1_50/block1/unit_1/bottleneck_v1/conv1/weights, ../BatchNorm/gamma: TF-Slim's

What the local branch, a classifier or an optimiser keeps is left out. The files that the authors
publish have not been at hand. They are models of TF1: the authors' tools load them in a way in
which what the public exporters write cannot be loaded. The public code has an option that makes its
network compatible with TF-Slim's, so their names are expected to be of the third kind, which nobody
has confirmed. Which scope the layer after the pooling has there is not public either; it is
known by its shape, which nothing else in the network has.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from string import ascii_lowercase

import torch

from megloc_kapture.errors import DataError
from megloc_kapture.nets.delg import DESCRIPTOR_SIZE, DelgNet, Form
from megloc_kapture.nets.loading import load_strictly
from megloc_kapture.nets.resnet import Depth

_ATTRIBUTE = "/.ATTRIBUTES/VARIABLE_VALUE"
_NAMED = 8  # variables that a message names
_DEPTHS: dict[int, Depth] = {6: 50, 23: 101}  # by the blocks of the third stage

_WORD = r"/(?P<word>kernel|bias|gamma|beta|moving_mean|moving_variance)$"
_OBJECTS = re.compile(
    r"(?:^|/)backbone/(?:l(?P<stage>[2-5])(?P<block>[a-z])/)?"
    r"(?P<layer>conv1|bn_conv1|embedding_layer|(?:conv|bn)(?:2[abc]|_shortcut))" + _WORD
)
_NUMBERED = re.compile(
    r"(?:^|/)backbone/l(?P<stage>[2-5])(?P<block>[a-z])/variables/(?P<number>1?\d|2[0-3])$"
)
_LAYERS = re.compile(
    r"(?:^|/)(?:(?P<layer>conv1|bn_conv1|embedding_layer)"
    r"|(?P<kind>res|bn)(?P<stage>[2-5])(?P<block>[a-z])_branch(?P<branch>2[abc]|1))" + _WORD
)
_SLIM = re.compile(
    r"(?:^|/)resnet_v1_(?:50|101)/"
    r"(?:block(?P<stage>[1-4])/unit_(?P<unit>\d+)/bottleneck_v1/)?"
    r"(?P<layer>conv[123]|shortcut)/"
    r"(?P<norm>BatchNorm/)?(?P<word>weights|biases|gamma|beta|moving_mean|moving_variance)$"
)
_TORCH_WORDS = {
    "kernel": "weight",
    "weights": "weight",
    "biases": "bias",
    "gamma": "weight",
    "beta": "bias",
    "moving_mean": "running_mean",
    "moving_variance": "running_var",
}
# of the objects' attributes and the layers' branches to torchvision's, convolution and norm
_PARTS = {
    "2a": ("conv1", "bn1"),
    "2b": ("conv2", "bn2"),
    "2c": ("conv3", "bn3"),
    "1": ("downsample.0", "downsample.1"),
}
# of a convolution and the norm after it, in the order that Keras counts them
_NUMBERED_WORDS = ("kernel", "bias", "gamma", "beta", "moving_mean", "moving_variance")


def delg_from(tensors: Mapping[str, torch.Tensor], where: str) -> DelgNet:
    """The network of a checkpoint's variables, ready for inference.

    Parameters
    ----------
    tensors : variable name -> values, as a TensorFlow checkpoint has them.
    where : the file, for messages.

    Raises
    ------
    DataError : the names are of no kind that is known, or variables are missing; says what was
        found.
    """
    form, state = delg_state(tensors, where)
    blocks = {key.split(".")[1] for key in state if key.startswith("layer3.")}
    if len(blocks) not in _DEPTHS:
        raise DataError(
            f"no DELG: {len(blocks)} blocks in the third stage, not 6 (ResNet-50) or 23 "
            f"(ResNet-101); {_found(tensors)}",
            path=where,
        )
    net = DelgNet(_DEPTHS[len(blocks)], form)
    counters = [key for key in net.state_dict() if key.endswith(".num_batches_tracked")]
    load_strictly(net, state, where, may_lack=counters)
    return net.eval()


def delg_state(
    tensors: Mapping[str, torch.Tensor], where: str
) -> tuple[Form, dict[str, torch.Tensor]]:
    """The form of the network, and a state dict for it, of a checkpoint's variables."""
    variables = {name.removesuffix(_ATTRIBUTE): values for name, values in tensors.items()}
    for form, key_of in _KINDS:
        state: dict[str, torch.Tensor] = {}
        for name, values in variables.items():
            key = key_of(name)
            if key is None:
                continue
            if key in state:
                raise DataError(f"{key} is in it twice, once as {name}", path=where)
            state[key] = _torch_layout(values)
        if "layer1.0.conv1.weight" in state:
            if form == "slim":
                state |= _embedding_by_shape(variables, where)
            return form, state
    raise DataError(
        "no DELG whose variables are named in a known way (backbone/l2a/conv2a/kernel, "
        "res2a_branch2a/kernel or resnet_v1_101/block1/unit_1/bottleneck_v1/conv1/weights "
        f"expected); {_found(tensors)}",
        path=where,
    )


def _key_of_object(name: str) -> str | None:
    if numbered := _NUMBERED.search(name):
        turn, row = divmod(int(numbered["number"]), len(_NUMBERED_WORDS))
        part, word = list(_PARTS)[turn], _NUMBERED_WORDS[row]
        return _key(numbered["stage"], numbered["block"], part, row > 1, word)
    found = _OBJECTS.search(name)
    if found is None:
        return None
    layer, stage = found["layer"], found["stage"]
    if stage is None:
        return _key_of_stem(layer, found["word"])
    is_norm = layer.startswith("bn")
    part = layer.removeprefix("bn").removeprefix("conv").replace("_shortcut", "1")
    return None if part not in _PARTS else _key(stage, found["block"], part, is_norm, found["word"])


def _key_of_layer(name: str) -> str | None:
    found = _LAYERS.search(name)
    if found is None or "attention/" in name:  # the local branch has a bn_conv1 of its own
        return None
    if found["layer"] is not None:
        return _key_of_stem(found["layer"], found["word"])
    is_norm = found["kind"] == "bn"
    return _key(found["stage"], found["block"], found["branch"], is_norm, found["word"])


def _key(stage: str, block: str, part: str, is_norm: bool, word: str) -> str:
    place = f"layer{int(stage) - 1}.{ascii_lowercase.index(block)}"
    return f"{place}.{_PARTS[part][is_norm]}.{_TORCH_WORDS.get(word, word)}"


def _key_of_stem(layer: str, word: str) -> str | None:
    names = {"conv1": "conv1", "bn_conv1": "bn1", "embedding_layer": "embedding"}
    return f"{names[layer]}.{_TORCH_WORDS.get(word, word)}" if layer in names else None


def _key_of_slim(name: str) -> str | None:
    found = _SLIM.search(name)
    if found is None:
        return None
    layer, is_norm = found["layer"], found["norm"] is not None
    if layer == "shortcut":
        part = f"downsample.{int(is_norm)}"
    else:
        part = f"bn{layer[-1]}" if is_norm else layer
    if found["stage"] is not None:
        part = f"layer{found['stage']}.{int(found['unit']) - 1}.{part}"
    return f"{part}.{_TORCH_WORDS[found['word']]}"


_KINDS: tuple[tuple[Form, Callable[[str], str | None]], ...] = (
    ("keras", _key_of_object),
    ("keras", _key_of_layer),
    ("slim", _key_of_slim),
)


def _embedding_by_shape(
    variables: Mapping[str, torch.Tensor], where: str
) -> dict[str, torch.Tensor]:
    """The one layer 2048 -> 2048 with a bias, dense or as a 1x1 convolution."""
    size = DESCRIPTOR_SIZE
    found = []
    for name, values in variables.items():
        scope, _, word = name.rpartition("/")
        biases = [variables.get(f"{scope}/{other}") for other in ("biases", "bias")]
        bias = next((b for b in biases if b is not None), None)
        is_square = tuple(values.shape) in ((size, size), (1, 1, size, size))
        if word in ("weights", "kernel") and is_square and bias is not None:
            found.append((scope, values.reshape(size, size).T.contiguous(), bias))
    if len(found) != 1:
        scopes = ", ".join(scope for scope, *_ in found) or "none"
        raise DataError(
            f"no DELG: one layer of {size} x {size} weights with a bias expected beside the "
            f"ResNet; there is {scopes}; {_found(variables)}",
            path=where,
        )
    return {"embedding.weight": found[0][1], "embedding.bias": found[0][2]}


def _torch_layout(values: torch.Tensor) -> torch.Tensor:
    """Inputs last of a convolution or a dense layer, which have them before the outputs."""
    if values.ndim == 4:
        return values.permute(3, 2, 0, 1).contiguous()
    return values.T.contiguous() if values.ndim == 2 else values


def _found(names: Iterable[str]) -> str:
    some = sorted(names)
    more = len(some) - _NAMED
    return "found: " + ", ".join(some[:_NAMED]) + (f" and {more} more" if more > 0 else "")

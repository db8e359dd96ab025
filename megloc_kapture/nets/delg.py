"""DELG's global branch (Cao et al., ECCV 2020): a ResNet, generalized-mean pooling and a layer.

Two forms of its ResNet exist in TensorFlow, and which one a checkpoint is of shows in the names of
its variables:

    keras   the authors' public training code: strides on the first 1x1 convolution of a stage and
            its shortcut, convolutions with bias, epsilon 1e-3, margins as TensorFlow's SAME, a
            maximum pooling without margin (VALID)
    slim    TF-Slim's resnet_v1: strides on the 3x3 convolution of a stage's last block, of all
            stages but the last, convolutions without bias, epsilon 1e-5, margins of half a kernel,
            a maximum pooling padded as SAME

Both have stride 32 and 2048 channels at the end. What the training code calls ``block3_strides``
moves a stride from two 1x1 convolutions to a subsampling before them and changes nothing here.
The module's keys are those of torchvision's ResNet, and ``embedding`` for the last layer. Three
ways of naming the variables are known, and any scope may stand before them:

    objects   backbone/l2a/conv2a/kernel, backbone/l2a/bn_shortcut/gamma,
              backbone/embedding_layer/kernel: attributes of the objects of the public training
              code, each before ``/.ATTRIBUTES/VARIABLE_VALUE``. In an exported model the variables
              of a block may have numbers: backbone/l2a/variables/0 to 17, or 23 with a shortcut
    layers    res2a_branch2a/kernel, bn2a_branch1/gamma, embedding_layer/kernel: the same layers by
              their names, as a graph of TF1 has them
    slim      resnet_v1_50/block1/unit_1/bottleneck_v1/conv1/weights, ../BatchNorm/gamma: TF-Slim's

What the local branch, a classifier or an optimiser keeps is left out. The files that the authors
publish have not been at hand: they are models of TF1, of a network that is compatible with
TF-Slim's, so names of the third kind are expected. Which scope the layer after the pooling has
there is not public; it is known by its shape, which nothing else in the network has.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from string import ascii_lowercase
from typing import Literal

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.errors import DataError
from megloc_kapture.nets.runtime import batch_counters, first_few, load_strictly
from megloc_kapture.nets.score_maps import conv_same
from megloc_kapture.nets.trunks import (
    RESNET_BLOCKS,
    RESNET_DEPTHS,
    RESNET_EXPANSION,
    RESNET_WIDTHS,
    Bottleneck,
    Depth,
    generalized_mean,
)

Form = Literal["keras", "slim"]
DESCRIPTOR_SIZE = 2048
_POWER = 3.0  # section 3.2 of the paper: fixed
_EPSILONS: dict[Form, float] = {"keras": 1e-3, "slim": 1e-5}
_LEAST_PX = 5  # a smaller side leaves the pooling without margin nothing
_ATTRIBUTE = "/.ATTRIBUTES/VARIABLE_VALUE"
_CONVOLUTION = {"kernel": "weight", "bias": "bias"}
_SLIM_CONVOLUTION = {"weights": "weight", "biases": "bias"}
_NORM = {
    "gamma": "weight",
    "beta": "bias",
    "moving_mean": "running_mean",
    "moving_variance": "running_var",
}
# of a block, convolution and norm: the branch in Keras' names to torchvision's attributes
_PARTS = {
    "2a": ("conv1", "bn1"),
    "2b": ("conv2", "bn2"),
    "2c": ("conv3", "bn3"),
    "1": ("downsample.0", "downsample.1"),
}
_STEM = (
    ("conv1", "conv1", _CONVOLUTION),
    ("bn_conv1", "bn1", _NORM),
    ("embedding_layer", "embedding", _CONVOLUTION),
)


class DelgNet(nn.Module):
    """Image to a vector at one scale; :func:`describe` joins several."""

    def __init__(self, depth: Depth, form: Form) -> None:
        super().__init__()
        self.form = form
        keras, epsilon = form == "keras", _EPSILONS[form]
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, bias=keras)
        self.bn1 = nn.BatchNorm2d(64, eps=epsilon)
        bottleneck = partial(Bottleneck, strided_first=keras, bias=keras, epsilon=epsilon)
        channels, blocks_of = 64, RESNET_BLOCKS[depth]
        for stage, (width, blocks) in enumerate(zip(RESNET_WIDTHS, blocks_of, strict=True), 1):
            # a stage and the block of it that has the stride
            strided = (stage > 1, 0) if keras else (stage < 4, blocks - 1)
            layers = nn.Sequential()
            for block in range(blocks):
                stride = 2 if strided == (True, block) else 1
                layers.append(bottleneck(channels, width, stride=stride))
                channels = width * RESNET_EXPANSION
            self.add_module(f"layer{stage}", layers)
        self.embedding = nn.Linear(channels, DESCRIPTOR_SIZE)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Vectors (B, 2048), of any length, of RGB images (B, 3, H, W) in [-1, 1]."""
        for number in range(1, 5):
            layer = self.get_submodule(f"layer{number}")
            image = layer(self._stem(image) if number == 1 else image)
        # in half precision the convolutions alone
        with torch.autocast(image.device.type, enabled=False):
            return self.embedding(generalized_mean(image, _POWER))

    def _stem(self, image: torch.Tensor) -> torch.Tensor:
        weight, bias = self.conv1.weight, self.conv1.bias
        if self.form == "keras":
            x = conv_same(image, weight, bias, 2)
        else:
            x = functional.conv2d(image, weight, bias, 2, padding=3)
        x = functional.relu(self.bn1(x), inplace=True)
        if self.form == "slim":
            # SAME: one margin less on the left and at the top where a side is even
            height, width = x.shape[-2:]
            x = functional.pad(x, (width % 2, 1, height % 2, 1))  # 0 is the least after a ReLU
        return functional.max_pool2d(x, 3, stride=2)


def describe(net: DelgNet, image: torch.Tensor, scales: Sequence[float]) -> torch.Tensor:
    """Unit vectors, float32 (B, 2048): the sum of those at several scales (section 4.1).

    ``image`` is RGB (B, 3, H, W) in 0 to 255; at each scale it is resized bilinearly, without
    smoothing, to sides rounded to whole pixels, halves to even ones. Raises DataError for an image
    that is too small for the network at the least scale.
    """
    normalised = (image - 128.0) / 128.0
    total = image.new_zeros(len(image), DESCRIPTOR_SIZE)
    for scale in scales:
        # in the precision of TensorFlow's own product, on which a half can depend
        sides = [round(float(np.float32(n) * np.float32(scale))) for n in image.shape[-2:]]
        if min(sides) < _LEAST_PX:
            raise DataError(
                f"an image of {image.shape[-1]} x {image.shape[-2]} pixels is too small for DELG: "
                f"at scale {scale:g} its sides must be at least {_LEAST_PX}"
            )
        resized = functional.interpolate(
            normalised, sides, mode="bilinear", align_corners=False, antialias=False
        )
        total += functional.normalize(net(resized))
    return functional.normalize(total)


def delg_from(tensors: Mapping[str, torch.Tensor], where: str) -> DelgNet:
    """The network of a checkpoint's variables, name -> values, ready for inference.

    Raises DataError that names the file ``where`` and what was found: names of no kind that is
    known, or variables that are missing.
    """
    form, state = delg_state(tensors, where)
    blocks = {key.split(".")[1] for key in state if key.startswith("layer3.")}
    if len(blocks) not in RESNET_DEPTHS:
        raise DataError(
            f"no DELG: {len(blocks)} blocks in the third stage, not 6 (ResNet-50) or 23 "
            f"(ResNet-101); {_found(tensors)}",
            path=where,
        )
    net = DelgNet(RESNET_DEPTHS[len(blocks)], form)
    return load_strictly(net, state, where, may_lack=batch_counters(net)).eval()


def delg_state(
    tensors: Mapping[str, torch.Tensor], where: str
) -> tuple[Form, dict[str, torch.Tensor]]:
    """The form of the network, and a state dict for it, of a checkpoint's variables."""
    variables = {name.removesuffix(_ATTRIBUTE): values for name, values in tensors.items()}
    kinds: tuple[tuple[Form, Iterator[tuple[str, str]]], ...] = (
        ("keras", _keras_names(layers=False)),
        ("keras", _keras_names(layers=True)),
        ("slim", _slim_names()),
    )
    for form, names in kinds:
        keys = dict(names)
        state: dict[str, torch.Tensor] = {}
        for name, values in variables.items():
            if "attention/" in name:  # the local branch, which has a bn_conv1 of its own
                continue
            parts = name.split("/")
            scoped = ("/".join(parts[start:]) for start in range(len(parts)))
            key = next((keys[inner] for inner in scoped if inner in keys), None)
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


def _keras_names(*, layers: bool) -> Iterator[tuple[str, str]]:
    """Names of the kind ``objects`` or ``layers``, without a scope, and the module's keys.

    Of all blocks that there may be: a stage's are named by the letters.
    """
    above = "" if layers else "backbone/"
    for layer, key, words in _STEM:
        yield from ((f"{above}{layer}/{word}", f"{key}.{own}") for word, own in words.items())
    for stage, (number, letter) in product(range(1, 5), enumerate(ascii_lowercase)):
        block, place, count = f"{stage + 1}{letter}", f"layer{stage}.{number}", 0
        for branch, keys in _PARTS.items():
            part = "_shortcut" if branch == "1" else branch
            names = f"backbone/l{block}/conv{part}", f"backbone/l{block}/bn{part}"
            if layers:
                names = f"res{block}_branch{branch}", f"bn{block}_branch{branch}"
            for name, key, words in zip(names, keys, (_CONVOLUTION, _NORM), strict=True):
                for word, own in words.items():
                    yield f"{name}/{word}", f"{place}.{key}.{own}"
                    if not layers:
                        yield f"backbone/l{block}/variables/{count}", f"{place}.{key}.{own}"
                    count += 1


def _slim_names() -> Iterator[tuple[str, str]]:
    """The same of the kind ``slim``."""
    layers = list(zip(("conv1", "conv2", "conv3", "shortcut"), _PARTS.values(), strict=True))
    places = [("", "", layers[:1])]
    for stage, unit in product(range(1, 5), range(len(ascii_lowercase))):
        scope = f"block{stage}/unit_{unit + 1}/bottleneck_v1/"
        places.append((scope, f"layer{stage}.{unit}.", layers))
    for depth, (scope, place, here) in product(RESNET_BLOCKS, places):
        for layer, (convolution, norm) in here:
            name = f"resnet_v1_{depth}/{scope}{layer}"
            for word, own in _SLIM_CONVOLUTION.items():
                yield f"{name}/{word}", f"{place}{convolution}.{own}"
            for word, own in _NORM.items():
                yield f"{name}/BatchNorm/{word}", f"{place}{norm}.{own}"


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
    return "found: " + first_few(sorted(names), 8)

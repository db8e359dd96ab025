"""Keys and shapes of the published checkpoints, and random weights of networks."""

from __future__ import annotations

import math
import runpy
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from megloc_kapture.nets.megaloc import DinoV2, MegaLocNet
from megloc_kapture.nets.superglue import ImageKeypoints, normalise_keypoints
from megloc_kapture.values import ImageFeatures

Net = TypeVar("Net", bound=nn.Module)
Tensors = dict[str, torch.Tensor]
Shapes = dict[str, tuple[int, ...]]
FOLDER = Path(__file__).parent
# random weights by key and shape, which are the same under every version of numpy and torch
random_state = runpy.run_path(str(FOLDER / "data/deeplabv3plus/make_reference.py"))["random_state"]


def published_shapes(name: str) -> Shapes:
    """Return keys and shapes from a file in ``keys``."""
    return _read(FOLDER / "keys" / f"{name}.txt")


def delg_shapes(kind: str) -> Shapes:
    """Return names and shapes of the variables in TensorFlow's checkpoint."""
    return _read(FOLDER / "data" / "delg" / f"{kind}.txt")


def _read(path: Path) -> Shapes:
    pairs = (row.split() for row in path.read_text(encoding="utf-8").splitlines())
    return {key: () if s == "scalar" else tuple(map(int, s.split("x"))) for key, s in pairs}


def delg_variables(kind: str) -> dict[str, NDArray[np.float32]]:
    """Return the random variables for which data/delg/reference.npz was written."""
    drawn = {}
    words = ("kernel", "bias", "gamma", "beta", "moving_mean", "moving_variance")
    for name, shape in delg_shapes(kind).items():
        random = np.random.RandomState(zlib.crc32(name.encode()))
        word = name.removesuffix("/.ATTRIBUTES/VARIABLE_VALUE").rpartition("/")[2]
        word = words[int(word) % 6] if word.isdigit() else word
        low, high = {"moving_variance": (0.5, 2.0), "gamma": (0.3, 0.7)}.get(word, (-0.2, 0.2))
        if len(shape) > 1:
            values = random.standard_normal(shape) * np.sqrt(2 / np.prod(shape[:-1]))
        else:
            values = random.uniform(low, high, shape)
        drawn[name] = np.asarray(values, np.float32)
    return drawn


def plugin(kind: Any, weights: Path | str, **options: Any) -> Any:
    given = {"weights": str(weights), "device": "cpu", **options}
    return kind(kind.Options.model_validate(given))


def unit(values: NDArray[np.floating]) -> NDArray[np.float32]:
    return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32)


def random_features(number: int, size: int, seed: int) -> ImageFeatures:
    """Return keypoints (N, 3) with scores, at random, and descriptors of a size."""
    rng = np.random.default_rng(seed)
    xy = 0.5 + rng.random((number, 2)) * (639, 479)
    table = np.column_stack([xy, rng.uniform(0.01, 1, number)]).astype(np.float32)
    return ImageFeatures(table, unit(rng.normal(size=(number, size))), 640, 480)


def seen_again(
    first: ImageFeatures, seed: int, *, kept: int | None = None, new: int = 40, noise: float = 0.02
) -> ImageFeatures:
    """Return the first keypoints with noisy descriptors, and new ones, in another order."""
    rng = np.random.default_rng(seed)
    table, descriptors = first.keypoints_px[:kept], first.descriptors[:kept]
    others = random_features(new, descriptors.shape[1], seed + 100)
    noisy = unit(descriptors + noise * rng.normal(size=descriptors.shape))
    order = rng.permutation(len(noisy) + new)
    table = np.concatenate([table, others.keypoints_px])[order]
    return replace(
        first, keypoints_px=table, descriptors=np.concatenate([noisy, others.descriptors])[order]
    )


def superglue_input(image: ImageFeatures) -> ImageKeypoints:
    pixels = torch.from_numpy(image.keypoints_px[:, :2]) - 0.5
    return ImageKeypoints(
        normalise_keypoints(pixels, image.width, image.height),
        torch.from_numpy(image.keypoints_px[:, 2]),
        torch.from_numpy(image.descriptors),
    )


def small_megaloc() -> MegaLocNet:
    trunk = DinoV2(channels=12, depth=2, heads=3, grid=7)
    sizes = {"clusters": 5, "cluster_size": 4, "token_size": 6, "descriptor_size": 10}
    return MegaLocNet(trunk, **sizes)


def shapes_of(module: nn.Module) -> Shapes:
    return {key: tuple(value.shape) for key, value in module.state_dict().items()}


def random_tensors(name: str, seed: int = 0) -> Tensors:
    """Return random weights under the published keys, with activations near 1 at any depth."""
    generator = torch.Generator().manual_seed(seed)
    tensors = {}
    for key, shape in published_shapes(name).items():
        values = torch.randn(shape, generator=generator)
        if len(shape) > 1:
            values *= (2 / math.prod(shape[1:])) ** 0.5
        elif key.endswith(("running_var", "weight")):  # of a normalisation
            values = values.abs() + 0.5
        tensors[key] = torch.tensor(3) if key.endswith("num_batches_tracked") else values
        if key.endswith(("bias", "running_mean")):
            values *= 0.3
    return tensors


def randomised(module: Net, seed: int = 0) -> Net:
    """Draw weights with activations near 1 and non-trivial batch statistics."""
    torch.manual_seed(seed)
    for part in module.modules():
        if isinstance(part, nn.Conv2d):
            nn.init.kaiming_normal_(part.weight, mode="fan_in")
        if isinstance(part, nn.BatchNorm2d):
            nn.init.uniform_(part.weight, 0.3, 0.7)
            nn.init.uniform_(part.bias, -0.3, 0.3)
            part.running_mean.uniform_(-0.2, 0.2)
            part.running_var.uniform_(0.5, 2.0)
    return module.eval().requires_grad_(False)

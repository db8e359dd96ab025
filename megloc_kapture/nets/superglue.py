"""SuperGlue (Sarlin, DeTone, Malisiewicz and Rabinovich, CVPR 2020).

State-dict keys are those of Magic Leap's ``superglue_outdoor.pth`` and ``superglue_indoor.pth``.
The keypoints of all images of a batch stand in one tensor, one after the other: only attention and
transport know which belong together, so images of different sizes need no padding in the network.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.nets.loading import load_strictly
from megloc_kapture.nets.optimal_transport import log_optimal_transport

_HEADS = 4


@dataclass(frozen=True, eq=False)
class ImageKeypoints:
    """The keypoints of one image, as the network takes them.

    Attributes
    ----------
    xy : float32 (N, 2), normalised by :func:`normalise_keypoints`.
    scores : float32 (N,), of the detector, in (0, 1].
    descriptors : float32 (N, D).
    """

    xy: torch.Tensor
    scores: torch.Tensor
    descriptors: torch.Tensor


class SuperGlueNet(nn.Module):
    """The network: keypoints of pairs of images to the logarithm of their assignment.

    Parameters
    ----------
    encoder_sizes : outputs of the keypoint encoder's layers; the last is the descriptors' size D.
    num_layers : of the graph network; self and cross attention in turn.
    """

    def __init__(
        self, encoder_sizes: Sequence[int] = (32, 64, 128, 256, 256), num_layers: int = 18
    ) -> None:
        super().__init__()
        self.descriptor_size = encoder_sizes[-1]
        self.bin_score = nn.Parameter(torch.tensor(1.0))
        self.kenc = _KeypointEncoder(encoder_sizes)
        self.gnn = _GraphNetwork(self.descriptor_size, num_layers)
        self.final_proj = _Pointwise(self.descriptor_size, self.descriptor_size)

    def forward(
        self, pairs: Sequence[tuple[ImageKeypoints, ImageKeypoints]], iterations: int
    ) -> list[torch.Tensor]:
        """Log assignments of pairs of images that have keypoints, all at once.

        Parameters
        ----------
        iterations : of the optimal transport, which is float32 whatever the rest is.

        Returns
        -------
        For each pair of N and M keypoints float32 (N + 1, M + 1), the dustbins last.
        """
        images = [image for pair in pairs for image in pair]
        lengths = [len(image.scores) for image in images]
        device = self.bin_score.device.type
        # half precision would round positions to several pixels
        with torch.autocast(device, enabled=False):
            scores = torch.cat([image.scores for image in images])
            places = torch.column_stack([torch.cat([image.xy for image in images]), scores])
            tokens = torch.cat([image.descriptors for image in images]) + self.kenc.encoder(places)
        for index, layer in enumerate(self.gnn.layers):
            tokens = tokens + layer(tokens, lengths, cross=index % 2 == 1)
        with torch.autocast(device, enabled=False):
            sides = torch.split(self.final_proj(tokens), lengths)
            products = [
                a @ b.T / self.descriptor_size**0.5
                for a, b in zip(sides[::2], sides[1::2], strict=True)
            ]
            return log_optimal_transport(products, self.bin_score, iterations)


class _Pointwise(nn.Conv1d):
    """A convolution of size 1, in the checkpoints' shape, over the last axis of (..., C)."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__(channels_in, channels_out, kernel_size=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return functional.linear(x, self.weight[:, :, 0], self.bias)


def _perceptron(sizes: Sequence[int]) -> nn.Sequential:
    """Layers from size to size, all but the last with normalisation and activation."""
    layers: list[nn.Module] = []
    for size_in, size_out in pairwise(sizes):
        layers += [_Pointwise(size_in, size_out), nn.BatchNorm1d(size_out), nn.ReLU()]
    return nn.Sequential(*layers[:-2])


class _KeypointEncoder(nn.Module):
    def __init__(self, sizes: Sequence[int]) -> None:
        super().__init__()
        self.encoder = _perceptron([3, *sizes])


class _Attention(nn.Module):
    """Multi-head attention between the keypoints of one image and those of a source.

    In the checkpoints channel c belongs to head c mod 4. The weights are put in the order of heads
    on their way: they are much smaller than what they are multiplied with.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self.merge = _Pointwise(size, size)
        self.proj = nn.ModuleList([_Pointwise(size, size) for _ in range(3)])  # query, key, value

    def forward(self, tokens: torch.Tensor, lengths: Sequence[int], *, cross: bool) -> torch.Tensor:
        size = tokens.shape[1]
        by_head = torch.arange(size, device=tokens.device).view(-1, _HEADS).T.flatten()
        weight = torch.cat([part.get_parameter("weight")[by_head, :, 0] for part in self.proj])
        bias = torch.cat([part.get_parameter("bias")[by_head] for part in self.proj])
        projected = functional.linear(tokens, weight, bias)
        images = [
            image.view(-1, 3, _HEADS, size // _HEADS).transpose(0, 2).unbind(1)
            for image in torch.split(projected, list(lengths))
        ]
        attended = []
        for index, (query, _, _) in enumerate(images):
            _, key, value = images[index ^ 1 if cross else index]
            message = functional.scaled_dot_product_attention(query[None], key[None], value[None])
            attended.append(message[0].transpose(0, 1).flatten(1))
        return functional.linear(
            torch.cat(attended), self.merge.weight[:, by_head, 0], self.merge.bias
        )


class _Layer(nn.Module):
    """What attention adds to the keypoints (equation 3)."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.attn = _Attention(size)
        self.mlp = _perceptron([2 * size, 2 * size, size])

    def forward(self, tokens: torch.Tensor, lengths: Sequence[int], *, cross: bool) -> torch.Tensor:
        message = self.attn(tokens, lengths, cross=cross)
        return self.mlp(torch.cat([tokens, message], dim=1))


class _GraphNetwork(nn.Module):
    def __init__(self, size: int, num_layers: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList([_Layer(size) for _ in range(num_layers)])


def superglue(tensors: Mapping[str, torch.Tensor], where: str) -> SuperGlueNet:
    """The network with the weights of a checkpoint, of the sizes that the checkpoint has.

    Raises
    ------
    DataError : names the keys of ``where`` that do not fit.
    """
    encoder = _numbered(tensors, r"kenc\.encoder\.(\d+)\.weight", dimensions=3)
    layers = _numbered(tensors, r"gnn\.layers\.(\d+)\.attn\.merge\.weight", dimensions=3)
    net = SuperGlueNet(encoder, len(layers)) if encoder and layers else SuperGlueNet()
    load_strictly(net, tensors, where)
    return net


def _numbered(tensors: Mapping[str, torch.Tensor], pattern: str, *, dimensions: int) -> list[int]:
    """Number of outputs of the layers that the pattern names, in the order of their numbers."""
    found = {}
    for key, value in tensors.items():
        matched = re.fullmatch(pattern, key)
        if matched and value.ndim == dimensions:
            found[int(matched[1])] = value.shape[0]
    return [found[number] for number in sorted(found)]


def normalise_keypoints(xy: torch.Tensor, width: int, height: int) -> torch.Tensor:
    """Pixels (N, 2), first pixel's centre at (0, 0), by the centre and larger side of the image."""
    size = torch.tensor([width, height], dtype=xy.dtype, device=xy.device)
    return (xy - size / 2) / (0.7 * size.max())


def mutual_matches(
    log_assignment: torch.Tensor, threshold: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """The matches of an assignment (N + 1, M + 1): largest of their row and of their column.

    Returns
    -------
    matches : int64 (K, 2), sorted by row.
    scores : (K,), larger than the threshold.
    """
    inner = log_assignment[:-1, :-1]
    values, columns = inner.max(dim=1)
    rows = torch.arange(len(inner), device=inner.device)
    scores = values.exp()
    keep = (inner.argmax(dim=0)[columns] == rows) & (scores > threshold)
    return torch.stack([rows[keep], columns[keep]], dim=1), scores[keep]

"""SuperGlue (Sarlin, DeTone, Malisiewicz and Rabinovich, CVPR 2020), with official parameter names.

All keypoints of a batch are in one tensor without padding; only attention and transport separate
the images. Optimal transport (section 3.2) is Sinkhorn's algorithm: its scaling vectors multiply
the matrix exp(Z + u + v) and are absorbed into the log potentials u and v before they grow
(Schmitzer, "Stabilized sparse scaling algorithms", SIAM J. Sci. Comput. 2019, section 3.1). The
first iteration is in the log domain; after it no product overflows, and the entries that are set to
zero are less than 1e-7 of a sum.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.nets.runtime import load_strictly

_HEADS = 4
_LARGEST_SCALE = 2.0e4  # scales above this or below its inverse are absorbed into the potentials
_SMALLEST_ENTRY = 1e-30  # smaller kernel entries become 0, which avoids slow subnormal products
_PADDING = -1e30  # log score of padding: no mass, but unlike infinity a finite gradient


@dataclass(frozen=True, eq=False)
class ImageKeypoints:
    """Keypoints of one image as the network's input, all float32."""

    xy: torch.Tensor  # (N, 2), normalised by :func:`normalise_keypoints`
    scores: torch.Tensor  # (N,), detector scores in (0, 1]
    descriptors: torch.Tensor  # (N, D)


class SuperGlueNet(nn.Module):
    """SuperGlue's network from keypoints of image pairs to log assignments.

    The last of ``encoder_sizes`` is the descriptor size D; the layers alternate self and cross
    attention.
    """

    def __init__(
        self, encoder_sizes: Sequence[int] = (32, 64, 128, 256, 256), num_layers: int = 18
    ) -> None:
        super().__init__()
        self.descriptor_size = encoder_sizes[-1]
        self.bin_score = nn.Parameter(torch.tensor(1.0))
        self.kenc = nn.ModuleDict({"encoder": _perceptron([3, *encoder_sizes])})
        layers = [_Layer(self.descriptor_size) for _ in range(num_layers)]
        self.gnn = nn.ModuleDict({"layers": nn.ModuleList(layers)})
        self.final_proj = _Pointwise(self.descriptor_size, self.descriptor_size)

    def forward(
        self, pairs: Sequence[tuple[ImageKeypoints, ImageKeypoints]], iterations: int
    ) -> list[torch.Tensor]:
        """Return log assignments float32 (N + 1, M + 1), dustbins last.

        Each image must have keypoints.
        """
        images = [image for pair in pairs for image in pair]
        lengths = [len(image.scores) for image in images]
        device = self.bin_score.device.type
        # half precision would round positions by several pixels
        with torch.autocast(device, enabled=False):
            scores = torch.cat([image.scores for image in images])
            located = torch.column_stack([torch.cat([image.xy for image in images]), scores])
            encoded = self.kenc["encoder"](located)
            tokens = torch.cat([image.descriptors for image in images]) + encoded
        for number, layer in enumerate(self.gnn["layers"].children(), start=1):
            tokens = tokens + layer(tokens, lengths, cross=number % 2 == 0)
        with torch.autocast(device, enabled=False):
            sides = torch.split(self.final_proj(tokens), lengths)
            products = [
                a @ b.T / self.descriptor_size**0.5
                for a, b in zip(sides[::2], sides[1::2], strict=True)
            ]
            return log_optimal_transport(products, self.bin_score, iterations)


class _Pointwise(nn.Conv1d):
    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__(channels_in, channels_out, kernel_size=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return functional.linear(x, self.weight[:, :, 0], self.bias)


def _perceptron(sizes: Sequence[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for size_in, size_out in pairwise(sizes):
        layers += [_Pointwise(size_in, size_out), nn.BatchNorm1d(size_out), nn.ReLU()]
    return nn.Sequential(*layers[:-2])


class _Layer(nn.Module):
    """Message passing by multi-head attention (equation 3).

    Channel c of a checkpoint's attention belongs to head c mod 4.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        merge, proj = _Pointwise(size, size), [_Pointwise(size, size) for _ in range(3)]
        self.attn = nn.ModuleDict({"merge": merge, "proj": nn.ModuleList(proj)})
        self.mlp = _perceptron([2 * size, 2 * size, size])

    def forward(self, tokens: torch.Tensor, lengths: Sequence[int], *, cross: bool) -> torch.Tensor:
        size = tokens.shape[1]
        by_head = torch.arange(size, device=tokens.device).view(-1, _HEADS).T.flatten()
        merge, parts = self.attn["merge"], list(self.attn["proj"].children())
        weight = torch.cat([part.get_parameter("weight")[by_head, :, 0] for part in parts])
        bias = torch.cat([part.get_parameter("bias")[by_head] for part in parts])
        projected = functional.linear(tokens, weight, bias)
        images = [
            image.view(-1, 3, _HEADS, size // _HEADS).transpose(0, 2).unbind(1)
            for image in torch.split(projected, list(lengths))
        ]
        attended = []
        for index, (query, _, _) in enumerate(images):
            _, key, value = images[index ^ 1 if cross else index]
            read = functional.scaled_dot_product_attention(query[None], key[None], value[None])
            attended.append(read[0].transpose(0, 1).flatten(1))
        weight, bias = merge.get_parameter("weight")[:, by_head, 0], merge.get_parameter("bias")
        message = functional.linear(torch.cat(attended), weight, bias)
        return self.mlp(torch.cat([tokens, message], dim=1))


def superglue(tensors: Mapping[str, torch.Tensor], where: str) -> SuperGlueNet:
    encoder = _numbered(tensors, r"kenc\.encoder\.(\d+)\.weight")
    layers = _numbered(tensors, r"gnn\.layers\.(\d+)\.attn\.merge\.weight")
    net = SuperGlueNet(encoder, len(layers)) if encoder and layers else SuperGlueNet()
    return load_strictly(net, tensors, where)


def _numbered(tensors: Mapping[str, torch.Tensor], pattern: str) -> list[int]:
    """Return the output sizes of the convolutions that match a pattern, by their numbers."""
    sizes = {}
    for key, value in tensors.items():
        matched = re.fullmatch(pattern, key)
        if matched and value.ndim == 3:
            sizes[int(matched[1])] = value.shape[0]
    return [sizes[number] for number in sorted(sizes)]


def normalise_keypoints(xy: torch.Tensor, width: int, height: int) -> torch.Tensor:
    """Normalise pixel coordinates (N, 2) by the image's centre and larger side.

    The centre of the first pixel is (0, 0).
    """
    size = torch.tensor([width, height], dtype=xy.dtype, device=xy.device)
    return (xy - size / 2) / (0.7 * size.max())


def mutual_matches(
    log_assignment: torch.Tensor, threshold: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the mutual best matches of log assignments (N + 1, M + 1), and their scores (K,).

    Matches, int64 (K, 2), are sorted by row.
    """
    inner = log_assignment[:-1, :-1]
    values, columns = inner.max(dim=1)
    rows = torch.arange(len(inner), device=inner.device)
    scores = values.exp()
    keep = (inner.argmax(dim=0)[columns] == rows) & (scores > threshold)
    return torch.stack([rows[keep], columns[keep]], dim=1), scores[keep]


def log_optimal_transport(
    scores: Sequence[torch.Tensor], bin_score: torch.Tensor, iterations: int
) -> list[torch.Tensor]:
    """Compute log partial assignments by Sinkhorn's algorithm, dustbins last.

    After exponentiation, rows and columns sum to 1, the dustbin's row to M, its column to N.

    Parameters
    ----------
    scores : matrices (N, M) of any sizes, N and M at least 1, all float32 or all float64.
    bin_score : scalar, the dustbin score.
    iterations : at least 1; each normalises the rows, then the columns.
    """
    like = scores[0]
    rows, columns = max(s.shape[0] for s in scores), max(s.shape[1] for s in scores)
    couplings = like.new_full((len(scores), rows + 1, columns + 1), _PADDING)
    row_mass = like.new_zeros((len(scores), rows + 1))
    column_mass = like.new_zeros((len(scores), columns + 1))
    for k, matrix in enumerate(scores):
        n, m = matrix.shape
        couplings[k, : n + 1, : m + 1] = bin_score
        couplings[k, :n, :m] = matrix
        row_mass[k, :n], row_mass[k, n] = 1, m
        column_mass[k, :m], column_mass[k, m] = 1, n
    total = row_mass.sum(dim=1, keepdim=True)
    u, v = _potentials(couplings, row_mass / total, column_mass / total, iterations)
    u = u + total.log()
    whole = ((couplings + u[:, :, None]) + v[:, None, :]).to(like.dtype)
    return [whole[k, : len(matrix) + 1, : matrix.shape[1] + 1] for k, matrix in enumerate(scores)]


def _potentials(
    couplings: torch.Tensor, row_mass: torch.Tensor, column_mass: torch.Tensor, iterations: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return u (B, N + 1) and v (B, M + 1), float64, such that exp(Z + u + v) has the masses."""
    # 1 at padding, which is added to avoid 0 / 0 and log(0)
    row_padding = (row_mass == 0).to(couplings.dtype)
    column_padding = (column_mass == 0).to(couplings.dtype)

    def potential(mass: torch.Tensor, log_sum: torch.Tensor) -> torch.Tensor:
        return (mass.double().log() - log_sum).masked_fill(mass == 0, 0.0)

    u = potential(row_mass, couplings.logsumexp(dim=2))
    v = potential(column_mass, (couplings + u[:, :, None]).logsumexp(dim=1))
    kernel = _kernel(couplings, u, v)
    row_scale, column_scale = torch.ones_like(row_mass), torch.ones_like(column_mass)
    for _ in range(iterations - 1):
        sums = torch.matmul(kernel, column_scale[:, :, None])[:, :, 0]
        row_scale = row_mass / (sums + row_padding)
        sums = torch.matmul(row_scale[:, None, :], kernel)[:, 0]
        column_scale = column_mass / (sums + column_padding)
        if _extreme(row_scale + row_padding, column_scale + column_padding):
            u = u + (row_scale + row_padding).double().log()
            v = v + (column_scale + column_padding).double().log()
            kernel = _kernel(couplings, u, v)
            row_scale, column_scale = torch.ones_like(row_mass), torch.ones_like(column_mass)
    u = u + (row_scale + row_padding).double().log()
    return u, v + (column_scale + column_padding).double().log()


def _kernel(couplings: torch.Tensor, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    # large scores and potentials cancel: in float32 only four digits would remain correct
    exponents = (couplings + u[:, :, None]) + v[:, None, :]
    return functional.threshold(exponents.to(couplings.dtype).exp(), _SMALLEST_ENTRY, 0.0)


def _extreme(row_scale: torch.Tensor, column_scale: torch.Tensor) -> bool:
    smallest, largest = torch.aminmax(torch.cat([row_scale, column_scale], dim=1))
    return bool((largest > _LARGEST_SCALE) | (smallest < 1 / _LARGEST_SCALE))

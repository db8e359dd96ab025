"""MegaLoc (Berton and Masone, CVPR Workshops 2025): DINOv2 ViT-B/14, SALAD, a linear layer.

Parameters are named as in the authors' ``model.safetensors``; the older ``megaloc.torch``, with the
keys ``backbone.model.*`` and a ``mask_token``, is accepted too. DINOv2 (Oquab et al., TMLR 2024) is
the variant without registers. SALAD (Izquierdo and Civera, CVPR 2024) assigns patches to clusters
and a dustbin by optimal transport.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.errors import OptionError
from megloc_kapture.nets.runtime import load_strictly
from megloc_kapture.nets.trunks import imagenet_normalised

_OLDER_TRUNK = "backbone.model."
_ITERATIONS = 3  # of Sinkhorn's algorithm, as in training
PATCH_PX = 14

_EPSILON = 1e-6
_MLP_RATIO = 4
# added to the number of patches so that sizes are not rounded down; shifts all sampled positions
_OFFSET = 0.1


class MegaLocNet(nn.Module):
    """Network from image to unit-norm vector (``descriptor_size``,); ViT-B/14 by default."""

    def __init__(
        self,
        backbone: DinoV2 | None = None,
        *,
        clusters: int = 64,
        cluster_size: int = 256,
        token_size: int = 256,
        descriptor_size: int = 8448,
    ) -> None:
        super().__init__()
        self.backbone = backbone or DinoV2()
        sizes = {"clusters": clusters, "cluster_size": cluster_size, "token_size": token_size}
        salad = Salad(self.backbone.channels, **sizes)
        linear = nn.Linear(clusters * cluster_size + token_size, descriptor_size)
        self.aggregator = nn.ModuleDict({"agg": salad, "linear": linear})

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return unit-norm vectors float32 (B, 8448) of RGB images (B, 3, H, W) in [0, 1].

        Sides are cropped to multiples of 14; there must be more patches than clusters.
        """
        aggregated = self.aggregator["agg"](*self.backbone(imagenet_normalised(image)))
        return functional.normalize(self.aggregator["linear"](aggregated).float(), dim=1)


def squared(image: torch.Tensor, size_px: int) -> torch.Tensor:
    """Resize (B, 3, H, W) to (B, 3, size, size) with antialiasing, ignoring the aspect ratio."""
    return functional.interpolate(
        image, size=(size_px, size_px), mode="bilinear", align_corners=False, antialias=True
    )


def megaloc_from(tensors: Mapping[str, torch.Tensor], where: str) -> MegaLocNet:
    renamed = {
        key.replace(_OLDER_TRUNK, "backbone.", 1) if key.startswith(_OLDER_TRUNK) else key: value
        for key, value in tensors.items()
        if key != _OLDER_TRUNK + "mask_token"
    }
    with torch.device("meta"):  # avoids drawing 229 million random numbers
        network = MegaLocNet()
    network.to_empty(device="cpu")
    return load_strictly(network, renamed, where).eval()


class Salad(nn.Module):
    """SALAD: aggregates features of patches and of the image into one unit-norm vector.

    The input has ``channels`` channels, the hidden layers have ``hidden``, and the output has
    ``token_size + cluster_size * clusters`` components.
    """

    def __init__(
        self,
        channels: int,
        *,
        clusters: int = 64,
        cluster_size: int = 256,
        token_size: int = 256,
        hidden: int = 512,
    ) -> None:
        super().__init__()
        self.token_features = nn.Sequential(
            nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, token_size)
        )
        self.cluster_features = _per_patch(channels, hidden, cluster_size)
        self.score = _per_patch(channels, hidden, clusters)
        self.dust_bin = nn.Parameter(torch.tensor(1.0))

    def forward(self, patches: torch.Tensor, whole: torch.Tensor) -> torch.Tensor:
        """Aggregate features of patches (B, C, h, w) and image (B, C) into float32 (B, D)."""
        features = self.cluster_features(patches).flatten(2)
        # in half precision only two digits would be correct after the exponential
        shares = assignment(self.score(patches).flatten(2).float(), self.dust_bin)
        summed = torch.matmul(features, shares.to(features).mT).float()
        summed = functional.normalize(summed, dim=1)
        token = functional.normalize(self.token_features(whole).float(), dim=1)
        return functional.normalize(torch.cat([token, summed.flatten(1)], dim=1), dim=1)


def assignment(scores: torch.Tensor, dust_bin: torch.Tensor) -> torch.Tensor:
    """Assign N patches to K clusters by scores (B, K, N); return the weights (B, K, N).

    It runs three Sinkhorn iterations in the log domain. Each patch and each cluster has mass 1; the
    dustbin, with score ``dust_bin`` (), takes the rest of the patches' mass.
    """
    batch, clusters, patches = scores.shape
    if patches <= clusters:
        raise OptionError(
            f"an image of {patches} patches is too small for {clusters} clusters; enlarge it"
        )
    scores = torch.cat([scores, dust_bin.to(scores).expand(batch, 1, patches)], dim=1)
    log_taken = scores.new_zeros(clusters + 1)
    log_taken[-1] = math.log(patches - clusters)
    of_patch = scores.new_zeros(batch, 1, patches)
    for _ in range(_ITERATIONS):
        of_cluster = log_taken[:, None] - (scores + of_patch).logsumexp(2, keepdim=True)
        of_patch = -(scores + of_cluster).logsumexp(1, keepdim=True)
    return (scores + of_cluster + of_patch)[:, :-1].exp()


def _per_patch(channels: int, hidden: int, out: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, hidden, 1),
        nn.Identity(),  # in place of a dropout, so that the keys are those of the checkpoint
        nn.ReLU(),
        nn.Conv2d(hidden, out, 1),
    )


class DinoV2(nn.Module):
    """DINOv2: features of an image's patches and of the whole image; ViT-B by default."""

    def __init__(
        self, *, channels: int = 768, depth: int = 12, heads: int = 12, grid: int = 37
    ) -> None:
        super().__init__()
        self.channels = channels
        self.grid = grid
        self.cls_token = nn.Parameter(torch.zeros(1, 1, channels))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + grid * grid, channels))
        self.patch_embed = nn.ModuleDict(
            {"proj": nn.Conv2d(3, channels, PATCH_PX, stride=PATCH_PX)}
        )
        self.blocks = nn.ModuleList(Block(channels, heads) for _ in range(depth))
        self.norm = nn.LayerNorm(channels, eps=_EPSILON)

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return features of patches (B, C, H // 14, W // 14) and of the whole image (B, C).

        ``image`` is (B, 3, H, W), see :func:`megloc_kapture.nets.trunks.imagenet_normalised`;
        incomplete patches are cropped.
        """
        patches = self.patch_embed["proj"](image)
        rows, columns = patches.shape[-2:]
        tokens = patches.flatten(2).mT
        tokens = torch.cat([self.cls_token.expand(len(tokens), -1, -1), tokens], dim=1)
        tokens = tokens + self.positions(rows, columns)
        for block in self.blocks:
            tokens = block(tokens)
        tokens = self.norm(tokens)
        return tokens[:, 1:].mT.reshape(patches.shape), tokens[:, 0]

    def positions(self, rows: int, columns: int) -> torch.Tensor:
        """Return position embeddings, (1, 1 + rows * columns, C).

        They are interpolated bicubically without antialiasing. The scale is ``(rows + 0.1) / grid``
        as in DINOv2, not ``rows / grid`` as in Hugging Face's transformers; for 23 rows and a grid
        of 37, the sampled positions differ by up to 0.16 grid cells.
        """
        if rows == columns == self.grid:
            return self.pos_embed
        learnt = self.pos_embed.float()
        maps = learnt[:, 1:].mT.reshape(1, self.channels, self.grid, self.grid)
        scale = ((rows + _OFFSET) / self.grid, (columns + _OFFSET) / self.grid)
        maps = functional.interpolate(maps, scale_factor=scale, mode="bicubic")
        return torch.cat([learnt[:, :1], maps.flatten(2).mT], dim=1)


class Block(nn.Module):
    """Transformer block with LayerScale (Touvron et al., ICCV 2021)."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm1 = nn.LayerNorm(channels, eps=_EPSILON)
        qkv, proj = nn.Linear(channels, 3 * channels), nn.Linear(channels, channels)
        self.attn = nn.ModuleDict({"qkv": qkv, "proj": proj})
        self.ls1 = nn.ParameterDict({"gamma": torch.ones(channels)})
        self.norm2 = nn.LayerNorm(channels, eps=_EPSILON)
        fc1, fc2 = (
            nn.Linear(channels, _MLP_RATIO * channels),
            nn.Linear(_MLP_RATIO * channels, channels),
        )
        self.mlp = nn.Sequential(OrderedDict(fc1=fc1, activation=nn.GELU(), fc2=fc2))
        self.ls2 = nn.ParameterDict({"gamma": torch.ones(channels)})

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        tokens = tokens + self.ls1["gamma"] * self._attended(self.norm1(tokens))
        return tokens + self.ls2["gamma"] * self.mlp(self.norm2(tokens))

    def _attended(self, tokens: torch.Tensor) -> torch.Tensor:
        # (B, N, 3, heads, C / heads) -> three times (B, heads, N, C / heads)
        parts = self.attn["qkv"](tokens).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        query, key, value = parts.unbind(0)
        read = functional.scaled_dot_product_attention(query, key, value)
        return self.attn["proj"](read.transpose(1, 2).flatten(2))

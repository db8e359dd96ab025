"""DINOv2's vision transformer (Oquab et al., TMLR 2024) under the keys of its own checkpoints.

The variant without registers: patches of 14 pixels, one class token, learnt positions, layer scale.
``mask_token``, which only its training needs, is left out.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

PATCH_PX = 14

_EPSILON = 1e-6  # of the layer norms
_MLP_RATIO = 4
# in patches; it keeps a size from being rounded down, and moves every position that is read
_OFFSET = 0.1


class DinoV2(nn.Module):
    """An image to one feature per patch, and one of the whole.

    Parameters
    ----------
    channels, depth, heads : of the transformer; the defaults are those of ViT-B.
    grid : side, in patches, of the square image that the positions are learnt for; 37 are 518
        pixels.
    """

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
        """Normalised features of the last block.

        Parameters
        ----------
        image : (B, 3, H, W), see :func:`megloc_kapture.nets.trunks.imagenet_normalised`. Pixels
            at the right and at the bottom that fill no patch are left out.

        Returns
        -------
        patches : (B, C, H // 14, W // 14).
        whole : (B, C), the class token.
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
        """Position embeddings of the tokens of so many patches, (1, 1 + rows * columns, C).

        Learnt positions are scaled bicubically, without a filter against aliasing, as DINOv2 does
        it: by ``(rows + 0.1) / grid``, from which the positions read follow too, instead of
        by ``rows / grid``, as transformers does. At 23 patches of 37 they lie up to 0.16 learnt
        positions beside those.
        """
        if rows == columns == self.grid:
            return self.pos_embed
        learnt = self.pos_embed.float()
        maps = learnt[:, 1:].mT.reshape(1, self.channels, self.grid, self.grid)
        maps = functional.interpolate(
            maps,
            scale_factor=((rows + _OFFSET) / self.grid, (columns + _OFFSET) / self.grid),
            mode="bicubic",
        )
        return torch.cat([learnt[:, :1], maps.flatten(2).mT], dim=1)


class Block(nn.Module):
    """Attention, then a perceptron, each on normalised tokens, scaled, and added to them."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(channels, eps=_EPSILON)
        self.attn = Attention(channels, heads)
        self.ls1 = LayerScale(channels)
        self.norm2 = nn.LayerNorm(channels, eps=_EPSILON)
        self.mlp = Perceptron(channels)
        self.ls2 = LayerScale(channels)

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        tokens = tokens + self.ls1(self.attn(self.norm1(tokens)))
        return tokens + self.ls2(self.mlp(self.norm2(tokens)))


class Attention(nn.Module):
    """Every token attends to all; queries, keys and values are made in one layer, head by head."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        # (B, N, 3, heads, C / heads) -> three times (B, heads, N, C / heads)
        parts = self.qkv(tokens).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        query, key, value = parts.unbind(0)
        read = functional.scaled_dot_product_attention(query, key, value)
        return self.proj(read.transpose(1, 2).flatten(2))


class Perceptron(nn.Module):
    """Two layers with the exact GELU between."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(channels, _MLP_RATIO * channels)
        self.fc2 = nn.Linear(_MLP_RATIO * channels, channels)

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        return self.fc2(functional.gelu(self.fc1(tokens)))


class LayerScale(nn.Module):
    """A learnt factor per channel (Touvron et al., ICCV 2021)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(channels))

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        return tokens * self.gamma

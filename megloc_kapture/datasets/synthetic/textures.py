"""Procedural textures, painted from a seed.

Every painter is a function ``(rng, height, width, **params) -> uint8 (height, width, 3)`` RGB.
A :class:`TextureRecipe` names a painter with its size and seed, so that a world can be laid out
without painting it, and two surfaces with the same recipe look the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from megloc_kapture.datasets.synthetic import building_textures, object_textures
from megloc_kapture.datasets.synthetic.drawing import Rgb
from megloc_kapture.datasets.synthetic.options import stream

PAINTERS: dict[str, Callable[..., Rgb]] = {
    "wall": building_textures.paint_wall,
    "ground": building_textures.paint_ground,
    "window": building_textures.paint_window,
    "door": building_textures.paint_door,
    "shutter": building_textures.paint_shutter,
    "plain": building_textures.paint_plain,
    "glow": building_textures.paint_glow,
    "poster": object_textures.paint_poster,
    "sign": object_textures.paint_sign,
    "wood": object_textures.paint_wood,
    "cloth": object_textures.paint_cloth,
    "car": object_textures.paint_car,
}


@dataclass(frozen=True)
class TextureRecipe:
    """How to paint one texture.

    Parameters
    ----------
    painter : a name in :data:`PAINTERS`.
    width, height : texels.
    seed : of the texture's random stream.
    params : further arguments of the painter, as sorted (name, value) pairs.
    """

    painter: str
    width: int
    height: int
    seed: int
    params: tuple[tuple[str, str | float], ...] = ()

    def paint(self) -> Rgb:
        """The texture, uint8 (height, width, 3), RGB."""
        rng = stream(self.seed, self.painter)
        return PAINTERS[self.painter](rng, self.height, self.width, **dict(self.params))

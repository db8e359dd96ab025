from __future__ import annotations

import numpy as np
import pytest
from megloc_twins.drawing import material_tile, periodic_noise, smooth_noise
from megloc_twins.surfaces import ATLAS_WIDTH, NUM_LEVELS, build_atlas
from megloc_twins.textures import PAINTERS, TextureRecipe

SURFACE = (("material", "brick"), ("material_seed", 3.0))


def recipe(painter: str, seed: int = 5) -> TextureRecipe:
    params = SURFACE if painter in ("wall", "ground") else ()
    return TextureRecipe(painter, 100, 80, seed, params)


@pytest.mark.parametrize("painter", sorted(PAINTERS))
def test_a_recipe_gives_the_same_picture_each_time_and_another_for_another_seed(
    painter: str,
) -> None:
    picture = recipe(painter).paint()
    assert picture.shape == (80, 100, 3)
    assert picture.dtype == np.uint8
    np.testing.assert_array_equal(picture, recipe(painter).paint())
    if painter != "glow":  # lamps all look alike
        assert (picture != recipe(painter, seed=6).paint()).mean() > 0.3
        assert picture.std() > 3


def test_noise_is_normalised_and_periodic_noise_and_materials_repeat() -> None:
    rng = np.random.default_rng(0)
    smooth = smooth_noise(rng, 90, 130, cell=17, octaves=4)
    assert smooth.shape == (90, 130)
    assert abs(smooth.mean()) < 1e-3 and smooth.std() == pytest.approx(1, abs=1e-3)
    periodic = periodic_noise(rng, 128, cell=32)
    step = np.abs(np.diff(periodic, axis=0)).mean()
    assert np.abs(periodic[0] - periodic[-1]).mean() < 1.5 * step
    for kind in ("brick", "asphalt"):
        tile = material_tile(kind, 0)
        for axis in (0, 1):
            inside = np.abs(np.diff(tile, axis=axis)).mean(axis=(1 - axis, 2))
            seam = np.abs(np.take(tile, 0, axis) - np.take(tile, -1, axis)).mean()
            assert seam <= inside.max() * 1.01, kind


def test_the_atlas_holds_every_level_of_every_texture_apart_from_the_others() -> None:
    rng = np.random.default_rng(1)
    textures = [
        np.full((h, w, 3), shade, np.uint8)
        for shade, (h, w) in enumerate(rng.integers(1, 900, (40, 2)), start=1)
    ]
    atlas = build_atlas(textures)
    assert atlas.image.shape[1] == ATLAS_WIDTH
    covered = np.zeros(atlas.image.shape[:2], int)
    for index, texture in enumerate(textures):
        for level in range(NUM_LEVELS):
            x, y = atlas.corner[index, level].astype(int)
            w, h = atlas.size[index, level].astype(int)
            assert w == max(1, -(-texture.shape[1] // 2**level))
            # with a border of the same colour, so that lookups at the edge stay in it
            patch = atlas.image[y - 1 : y + h + 1, x - 1 : x + w + 1]
            assert (patch == index + 1).all()
            covered[y : y + h, x : x + w] += 1
    assert covered.max() == 1

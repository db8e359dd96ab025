"""Drawing shots of the world: image, depth and mask."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.atlas import Atlas, build_atlas
from megloc_kapture.datasets.synthetic.movers import mover_surfaces
from megloc_kapture.datasets.synthetic.places import Place
from megloc_kapture.datasets.synthetic.render import (
    depth_map,
    sample_colour,
    sample_grid,
    visible_surfaces,
)
from megloc_kapture.datasets.synthetic.sensor import bonnet, develop
from megloc_kapture.datasets.synthetic.shading import cloud_texture, radiance
from megloc_kapture.datasets.synthetic.shadow import ShadowMap, add_shadows, cast_shadows
from megloc_kapture.datasets.synthetic.shots import Shot

_BONNET_COVERS = 0.5  # share of a pixel from which the mask and the depth leave it out


@dataclass(frozen=True, eq=False)
class View:
    """A drawn shot.

    Parameters
    ----------
    image : uint8 (H, W, 3), RGB.
    depth_m : float32 (H, W), along the optical axis at the pixels' centres, 0 where nothing is
        seen or the bonnet hides it; moving objects count. None where not asked for.
    mask : bool (H, W), False on the bonnet.
    """

    image: NDArray[np.uint8]
    depth_m: NDArray[np.float32] | None
    mask: NDArray[np.bool_]


class PlacePainter:
    """Draws the shots of one place; painting the place's textures takes about a second."""

    def __init__(self, place: Place, *, seed: int, supersampling: int) -> None:
        self._place = place
        self._seed = seed
        self._supersampling = supersampling
        self._atlas: Atlas = build_atlas([recipe.paint() for recipe in place.recipes])
        self._clouds = cloud_texture(seed)
        self._shadows: tuple[tuple[float, float, float], ShadowMap] | None = None

    def draw(self, shot: Shot, *, depth: bool = False) -> View:
        """Draw one shot, with its depth if asked."""
        place = self._place
        movers = mover_surfaces(shot.movers)
        surfaces = place.surfaces.joined(movers)
        cam_from_place = shot.cam_from_world @ place.place_from_world.inverse()
        seen = visible_surfaces(
            surfaces, cam_from_place, sample_grid(shot.camera, self._supersampling)
        )
        shadows = None
        if any(shot.look.sun):
            shadows = add_shadows(self._static_shadows(shot.look.sun_direction), movers)
        light = radiance(
            seen,
            surfaces,
            sample_colour(seen, surfaces, self._atlas),
            shot.look,
            cam_from_place=cam_from_place,
            lamps=place.lamps,
            shadows=shadows,
            clouds=self._clouds,
        )
        bonnet_seed = self._seed if shot.bonnet else None
        image = develop(light, shot.look, self._supersampling, bonnet_seed=bonnet_seed)
        width, height = shot.camera.width, shot.camera.height
        mask = np.ones((height, width), bool)
        if bonnet_seed is not None:
            mask = bonnet(width, height, bonnet_seed)[0] < _BONNET_COVERS
        depth_m = None
        if depth:
            exact = visible_surfaces(surfaces, cam_from_place, sample_grid(shot.camera, 1))
            depth_m = depth_map(exact)
            depth_m[~mask] = 0
        return View(image, depth_m, mask)

    def _static_shadows(self, sun: tuple[float, float, float]) -> ShadowMap:
        """Shadows of what does not move; the last are kept, as shots often share their sun."""
        if self._shadows is None or self._shadows[0] != sun:
            self._shadows = (sun, cast_shadows(self._place.surfaces, sun))
        return self._shadows[1]

"""Which pixels of a rendered image show what stands still: the truth that masks are tested with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.movers import mover_surfaces
from megloc_kapture.datasets.synthetic.places import Place
from megloc_kapture.datasets.synthetic.render import sample_grid, visible_surfaces
from megloc_kapture.datasets.synthetic.sensor import bonnet
from megloc_kapture.datasets.synthetic.shots import Shot

_NOTHING = 1e-6  # of a pixel covered


def on_bonnet(shot: Shot, seed: int) -> NDArray[np.bool_]:
    """Pixels (H, W) that the car's bonnet covers in part or whole, of the world of ``seed``."""
    size = (shot.camera.width, shot.camera.height)
    if not shot.bonnet:
        return np.zeros(size[::-1], bool)
    return bonnet(*size, seed)[0] > _NOTHING


def on_movers(shot: Shot, place: Place) -> NDArray[np.bool_]:
    """Pixels (H, W) whose centre shows a person or a car; the bonnet is not looked at."""
    # the movers' surfaces come behind the place's own
    surfaces = place.surfaces.joined(mover_surfaces(shot.movers))
    cam_from_place = shot.cam_from_world @ place.place_from_world.inverse()
    seen = visible_surfaces(surfaces, cam_from_place, sample_grid(shot.camera, 1))
    return seen.surface >= len(place.surfaces)


def stands_still(shot: Shot, place: Place, seed: int) -> NDArray[np.bool_]:
    """Mask (H, W), True where neither the bonnet nor a moving thing is seen."""
    return ~(on_bonnet(shot, seed) | on_movers(shot, place))

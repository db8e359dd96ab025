"""What a laser scanner measures in the pixels of a cutout."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.indoor_floors import Floor
from megloc_kapture.datasets.synthetic.portable import product
from megloc_kapture.datasets.synthetic.render import NO_SURFACE, sample_grid, visible_surfaces
from megloc_kapture.values import Camera, RigidTransform

_RANGE_M = 18.0
_RANGE_NOISE_M = 0.001
_MIN_COSINE = 0.06  # a beam that grazes a surface does not come back
_DARK = 24.0  # mean of the channels, 0..255; less swallows the beam
_DROPOUTS = 0.02  # share of pixels without a return, for no reason


def scanned_points(
    floor: Floor,
    camera: Camera,
    cam_from_place: RigidTransform,
    cam_from_scan: RigidTransform,
    image: NDArray[np.uint8],
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """The point in each pixel of a cutout, float64 (H, W, 3), metres in the scan's frame.

    NaN where nothing came back: from glass and dark things, from far away, at grazing angles and
    now and then. The scanner is off by a millimetre, along its beam; numbers are rounded to what
    a float32 can hold, as in its own files.

    Parameters
    ----------
    image : uint8 (H, W, 3), what the camera saw.
    """
    grid = sample_grid(camera, 1)
    seen = visible_surfaces(floor.place.surfaces, cam_from_place, grid)
    surface = np.maximum(seen.surface, 0)
    rays = np.stack(np.broadcast_arrays(grid.x, grid.y, 1.0), axis=-1)
    inverse = np.einsum("hwk,hwk->hw", seen.planes[:, 0][surface], rays)
    hit = (seen.surface != NO_SURFACE) & (inverse > 0)
    points = rays / np.where(hit, inverse, np.nan)[..., None]
    distance = np.linalg.norm(points, axis=-1)
    normals = product(floor.place.surfaces.normals(), cam_from_place.rotation_matrix().T)
    cosine = -np.einsum("hwk,hwk->hw", normals[surface], points) / distance
    back = hit & ~floor.glass[surface] & (distance < _RANGE_M) & (cosine > _MIN_COSINE)
    back &= image.mean(axis=2) >= _DARK
    back &= rng.random(back.shape) >= _DROPOUTS
    noise = 1 + _RANGE_NOISE_M * rng.standard_normal(back.shape) / distance
    in_scan = product(points * noise[..., None], cam_from_scan.rotation_matrix())
    in_scan[~back] = np.nan
    return in_scan.astype(np.float32).astype(np.float64)

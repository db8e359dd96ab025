"""Drawing a twin's images, and what its sparse models are made of on the way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.sparse_points import SparsePoints
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions
from megloc_kapture.datasets.synthetic.shots import Shot
from megloc_kapture.datasets.synthetic.sift_points import sift_points
from megloc_kapture.datasets.synthetic.studio import draw_shots
from megloc_kapture.datasets.synthetic.tracks import exact_tracks
from megloc_kapture.datasets.synthetic.views import View
from megloc_kapture.features.colmap_sift import ColmapSift
from megloc_kapture.io.images import read_image_rgb, write_image
from megloc_kapture.stages.work import Track
from megloc_kapture.values import LocalFeatures


@dataclass(frozen=True, eq=False)
class MapShots:
    """What a sparse model needs of the drawn map images, by image name.

    Parameters
    ----------
    depths_m : float32 (H, W) along the optical axis, 0 where nothing is seen.
    features : COLMAP's SIFT; empty where the models' points are to be exact.
    """

    depths_m: Mapping[str, NDArray[np.float32]]
    features: Mapping[str, LocalFeatures]

    def points(
        self, shots: Sequence[Shot], *, points_per_shot: int, rng: np.random.Generator
    ) -> SparsePoints:
        """:func:`sift_points` where there are features, else :func:`exact_tracks`."""
        if self.features:
            return sift_points(shots, self.features, self.depths_m)
        return exact_tracks(shots, self.depths_m, points_per_shot=points_per_shot, rng=rng)


def draw_map_and_queries(
    world: SyntheticWorldOptions,
    mapping: Sequence[Shot],
    others: Sequence[Shot],
    images: Path,
    *,
    model_features: bool,
    executor: Executor | None,
    track: Track,
) -> MapShots:
    """Draw all shots and write them below ``images`` under their names.

    Parameters
    ----------
    mapping : shots whose depth is returned, with ``model_features`` their SIFT as well.
    others : shots that are drawn only.
    executor : shares the work among processes that see the same file system.
    """
    names = frozenset(shot.name for shot in mapping)
    finish = partial(_write, images, world.jpeg_quality, names if model_features else frozenset())
    drawn = draw_shots(
        world,
        [*mapping, *others],
        finish,
        with_depth=names,
        executor=executor,
        track=track,
    )
    return MapShots(
        {name: depth for name, (depth, _) in drawn.items() if depth is not None},
        {name: features for name, (_, features) in drawn.items() if features is not None},
    )


def _write(
    images: Path, jpeg_quality: int, with_features: frozenset[str], shot: Shot, view: View
) -> tuple[NDArray[np.float32] | None, LocalFeatures | None]:
    path = images / shot.name
    write_image(path, view.image, jpeg_quality=jpeg_quality)
    # of the image as it was written
    wanted = shot.name in with_features
    return view.depth_m, ColmapSift().extract(read_image_rgb(path)) if wanted else None

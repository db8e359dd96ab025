"""Queries: telephones held elsewhere than the rig stood, by day and at night."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.cameras import looking_at, query_camera
from megloc_kapture.datasets.synthetic.covisibility import (
    CoarseView,
    coarse_view,
    overlap,
    support,
)
from megloc_kapture.datasets.synthetic.looks import Condition, Look, day_look, night_look
from megloc_kapture.datasets.synthetic.movers import place_movers
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions, stream
from megloc_kapture.datasets.synthetic.places import Place
from megloc_kapture.datasets.synthetic.shots import Shot, noise_seed
from megloc_kapture.values import Camera, RigidTransform

_MAX_OVERLAP = 0.85  # no query is a copy of a mapping image
_MIN_SUPPORT = 0.6  # share of a query's view that the map can tell it
_ATTEMPTS = 300


def query_shots(
    options: SyntheticWorldOptions,
    place: Place,
    mapping: Sequence[Shot],
    condition: Condition,
    total: int,
) -> list[Shot]:
    """This place's share of the ``total`` queries of a condition.

    ``mapping`` are the mapping shots of the place.
    """
    world_from_place = place.place_from_world.inverse()
    map_views = [
        coarse_view(place.surfaces, shot.camera, shot.cam_from_world @ world_from_place)
        for shot in mapping
    ]
    shots = []
    for number in range(place.index, total, options.num_places):
        sensor_id = f"{condition}_{number:05d}"
        image = f"query/{condition}/{number:05d}.{options.image_format}"
        rng = stream(options.seed, "query", sensor_id)
        camera = query_camera(options, rng)
        position, yaw, cam_from_place = _query_pose(place, camera, map_views, rng)
        shots.append(
            Shot(
                name=image,
                role="query",
                condition=condition,
                place=place.index,
                timestamp=(100_000 if condition == "day" else 200_000) + number,
                sensor_id=sensor_id,
                camera=camera,
                cam_from_world=cam_from_place @ place.place_from_world,
                look=_query_look(options, condition, rng, image),
                movers=place_movers(place.plan, rng, options.moving_objects, position, yaw=yaw),
                bonnet=False,
            )
        )
    return shots


def _query_look(
    options: SyntheticWorldOptions, condition: Condition, rng: np.random.Generator, image: str
) -> Look:
    seed = noise_seed(options, image)
    if condition == "night":
        return night_look(rng, exposure=options.night_exposure, noise_seed=seed)
    return day_look(
        rng,
        azimuth=float(rng.uniform(-np.pi, np.pi)),
        elevation=float(np.radians(rng.uniform(35, 60))),
        overcast=float(rng.choice([0.1, 0.5, 1.0])),
        noise_seed=seed,
    )


def _query_pose(
    place: Place, camera: Camera, map_views: list[CoarseView], rng: np.random.Generator
) -> tuple[NDArray[np.float64], float, RigidTransform]:
    """Position (3,), yaw and ``cam_from_place`` of a query.

    Of a few hundred random poses the first that keeps its distance from things and is supported
    by the map without being a copy of one of its images; failing that, the one nearest to it.
    """
    low, high = place.plan.outline.min(0), place.plan.outline.max(0)
    best: tuple[float, NDArray[np.float64], float, RigidTransform] | None = None
    for _ in range(_ATTEMPTS):
        x, y = (float(v) for v in rng.uniform(low, high))
        yaw = float(rng.uniform(-np.pi, np.pi))
        pitch, roll = float(rng.normal(0.04, 0.06)), float(rng.normal(0, 0.06))
        position = np.array([x, y, rng.uniform(1.45, 1.8)])
        if not place.plan.is_free(x, y, 0.9):
            continue
        pose = looking_at(position, yaw, pitch, roll)
        view = coarse_view(place.surfaces, camera, pose)
        depth = view.depth[view.depth > 0]
        if np.percentile(depth, 10) < 1.2 or np.median(depth) < 3.5:
            continue
        share = max(overlap(view, other) for other in map_views)
        miss = max(share - _MAX_OVERLAP, _MIN_SUPPORT - support(view, map_views), 0.0)
        if best is None or miss < best[0]:
            best = (miss, position, yaw, pose)
        if miss == 0.0:
            break
    if best is None:  # every floor plan has room for a query
        raise RuntimeError(f"no free view in {place.name}")
    return best[1:]

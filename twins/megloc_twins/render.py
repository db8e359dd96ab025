"""Rendering of frames to images, depth and masks, on any executor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.stages.work import HERE, Work, ordered_map
from megloc_twins.frames import Frame
from megloc_twins.moving_objects import moving_object_surfaces
from megloc_twins.options import SyntheticWorldOptions
from megloc_twins.rasterization import depth_map, sample_colour, sample_grid, visible_surfaces
from megloc_twins.shading import (
    ShadowMap,
    add_shadows,
    bonnet,
    cast_shadows,
    cloud_texture,
    develop,
    radiance,
)
from megloc_twins.squares import Place, build_place
from megloc_twins.surfaces import Atlas, build_atlas

_BONNET_COVERS = 0.5  # share of a pixel from which the mask and the depth leave it out

Result = TypeVar("Result")
PlaceBuilder = Callable[[SyntheticWorldOptions, int], Place]
_FRAMES_PER_BATCH = 13  # painting a place's textures costs about as much as four images
_NOTHING = 1e-6  # of a pixel covered


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """A drawn frame.

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


class PlaceRenderer:
    """Draws the frames of one place; painting the place's textures takes about a second."""

    def __init__(self, place: Place, *, seed: int, supersampling: int) -> None:
        self._place = place
        self._seed = seed
        self._supersampling = supersampling
        self._atlas: Atlas = build_atlas([recipe.paint() for recipe in place.recipes])
        self._clouds = cloud_texture(seed)
        self._shadows: tuple[tuple[float, float, float], ShadowMap] | None = None

    def render(self, frame: Frame, *, depth: bool = False) -> RenderedFrame:
        """Draw one frame, with its depth if asked."""
        place = self._place
        moving_objects = moving_object_surfaces(frame.moving_objects)
        surfaces = place.surfaces.joined(moving_objects)
        cam_from_place = frame.cam_from_world @ place.place_from_world.inverse()
        seen = visible_surfaces(
            surfaces, cam_from_place, sample_grid(frame.camera, self._supersampling)
        )
        shadows = None
        if any(frame.lighting.sun):
            shadows = add_shadows(
                self._static_shadows(frame.lighting.sun_direction), moving_objects
            )
        light = radiance(
            seen,
            surfaces,
            sample_colour(seen, surfaces, self._atlas),
            frame.lighting,
            cam_from_place=cam_from_place,
            lamps=place.lamps,
            shadows=shadows,
            clouds=self._clouds,
        )
        bonnet_seed = self._seed if frame.bonnet else None
        image = develop(light, frame.lighting, self._supersampling, bonnet_seed=bonnet_seed)
        width, height = frame.camera.width, frame.camera.height
        mask = np.ones((height, width), bool)
        if bonnet_seed is not None:
            mask = bonnet(width, height, bonnet_seed)[0] < _BONNET_COVERS
        depth_m = None
        if depth:
            exact = visible_surfaces(surfaces, cam_from_place, sample_grid(frame.camera, 1))
            depth_m = depth_map(exact)
            depth_m[~mask] = 0
        return RenderedFrame(image, depth_m, mask)

    def _static_shadows(self, sun: tuple[float, float, float]) -> ShadowMap:
        """Shadows of what does not move; the last are kept, as frames often share their sun."""
        if self._shadows is None or self._shadows[0] != sun:
            self._shadows = (sun, cast_shadows(self._place.surfaces, sun))
        return self._shadows[1]


def render_frames(
    options: SyntheticWorldOptions,
    frames: Sequence[Frame],
    finish: Callable[[Frame, RenderedFrame], Result],
    *,
    with_depth: Iterable[str] = (),
    build: PlaceBuilder = build_place,
    sky_seed: int | None = None,
    work: Work = HERE,
) -> dict[str, Result]:
    """Render every frame and hand it to ``finish`` in the same process; its results by image name.

    Parameters
    ----------
    finish : called as ``finish(frame, rendered)``, in another process where there is an executor:
        a function of a module, or a ``functools.partial`` of one. It writes the files and returns
        what little the caller needs.
    with_depth : names of the frames that need ``depth_m``.
    build : lays out a place of these options by its index, the same in every process.
    sky_seed : of clouds and the dirt on the bonnet; the world's unless given.
    """
    seed = options.seed if sky_seed is None else sky_seed
    render = partial(_render, options, build, seed, frozenset(with_depth), finish)
    results = (
        pair for pairs in ordered_map(render, _batches(frames), work.executor) for pair in pairs
    )
    return dict(sorted(work.track(results, len(frames), "drawing"), key=lambda pair: pair[0]))


def _batches(frames: Sequence[Frame]) -> Iterator[list[Frame]]:
    """Frames of one place each."""
    for place in sorted({frame.place for frame in frames}):
        here = [frame for frame in frames if frame.place == place]
        for start in range(0, len(here), _FRAMES_PER_BATCH):
            yield here[start : start + _FRAMES_PER_BATCH]


@lru_cache(maxsize=1)
def _renderer(
    options: SyntheticWorldOptions, build: PlaceBuilder, seed: int, place: int
) -> PlaceRenderer:
    return PlaceRenderer(build(options, place), seed=seed, supersampling=options.supersampling)


def _render(
    options: SyntheticWorldOptions,
    build: PlaceBuilder,
    seed: int,
    with_depth: frozenset[str],
    finish: Callable[[Frame, RenderedFrame], Result],
    frames: Sequence[Frame],
) -> list[tuple[str, Result]]:
    renderer = _renderer(options, build, seed, frames[0].place)
    return [
        (frame.name, finish(frame, renderer.render(frame, depth=frame.name in with_depth)))
        for frame in frames
    ]


def on_bonnet(frame: Frame, seed: int) -> NDArray[np.bool_]:
    """Pixels (H, W) that the car's bonnet covers in part or whole, of the world of ``seed``."""
    size = (frame.camera.width, frame.camera.height)
    if not frame.bonnet:
        return np.zeros(size[::-1], bool)
    return bonnet(*size, seed)[0] > _NOTHING


def on_moving_objects(frame: Frame, place: Place) -> NDArray[np.bool_]:
    """Pixels (H, W) whose centre shows a person or a car; the bonnet is not looked at."""
    # the moving objects' surfaces come behind the place's own
    surfaces = place.surfaces.joined(moving_object_surfaces(frame.moving_objects))
    cam_from_place = frame.cam_from_world @ place.place_from_world.inverse()
    seen = visible_surfaces(surfaces, cam_from_place, sample_grid(frame.camera, 1))
    return seen.surface >= len(place.surfaces)


def stands_still(frame: Frame, place: Place, seed: int) -> NDArray[np.bool_]:
    """Mask (H, W), True where neither the bonnet nor a moving thing is seen."""
    return ~(on_bonnet(frame, seed) | on_moving_objects(frame, place))

"""Rendering of frames to images, depth and masks, on any executor.

Surface samples are lit by sun, sky and lamps, with shadows; bonnet, lens and sensor turn them into
pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.images import write_image
from megloc_kapture.stages.work import HERE, Work, ordered_map
from megloc_kapture.values import RigidTransform
from megloc_twins.drawing import periodic_noise
from megloc_twins.frames import Frame, Lighting, Triple
from megloc_twins.moving_objects import moving_object_surfaces
from megloc_twins.options import JPEG_QUALITY, SyntheticWorldOptions, TwinOptions, stream
from megloc_twins.portable import Float32, arctan2, averaged, blurred, exp, product, resized
from megloc_twins.rasterization import (
    NO_SURFACE,
    Visibility,
    bilinear,
    depth_map,
    sample_colour,
    sample_grid,
    visible_surfaces,
)
from megloc_twins.squares import Place, build_place
from megloc_twins.surfaces import Atlas, Surfaces, build_atlas
from megloc_twins.textures import TextureRecipe

Result = TypeVar("Result")
PlaceBuilder = Callable[[SyntheticWorldOptions, int], Place]

_FRAMES_PER_BATCH = 13  # each batch paints the textures, which takes as long as four frames
_BONNET_COVERS = 0.5  # covered share of a pixel above which mask and depth exclude it

_SHADOW_SIZE = 1024
_BIAS_M = 0.05  # prevents surfaces from shading themselves
_NOTHING = np.float32(-1e9)
_LAMP_RANGE_M = 14.0
_CLOUD_SIZE = 512


@dataclass(frozen=True, eq=False)
class ShadowMap:
    """Largest height along the sun's direction, on a grid of lines parallel to it."""

    axes: NDArray[np.float64]  # (3, 3), rows: the grid's x and y directions and the sun's
    low: NDArray[np.float64]  # (2,), the grid's corner
    step: float  # grid spacing, metres
    height: Float32  # (_SHADOW_SIZE, _SHADOW_SIZE), metres along the sun's direction

    def lit(self, x: Float32, y: Float32, z: Float32) -> Float32:
        """Return 1 for points in the sun, else 0; the coordinates have equal shapes, metres."""
        a = self.axes.astype(np.float32)
        gx, gy, up = (row[0] * x + row[1] * y + row[2] * z for row in a)
        gx = (gx - np.float32(self.low[0])) / np.float32(self.step) - np.float32(0.5)
        gy = (gy - np.float32(self.low[1])) / np.float32(self.step) - np.float32(0.5)
        beyond = cv2.BORDER_CONSTANT, float(_NOTHING)
        top = cv2.remap(self.height, gx, gy, cv2.INTER_NEAREST, None, *beyond)
        return (up + np.float32(_BIAS_M) > top).astype(np.float32)


@lru_cache(maxsize=1)  # consecutive frames of a place often have the same sun
def cast_shadows(surfaces: Surfaces, sun_direction: Triple) -> ShadowMap:
    """Return the shadow map of surfaces, whose fronts and backs cast shadows."""
    sun = np.array(sun_direction)
    side = np.cross([0.0, 0.0, 1.0] if abs(sun[2]) < 0.99 else [1.0, 0.0, 0.0], sun)
    side /= np.sqrt((side * side).sum())
    axes = np.stack([side, np.cross(sun, side), sun])
    flat = product(surfaces.corners(), axes.T)[..., :2]
    low, high = flat.min((0, 1)) - 0.1, flat.max((0, 1)) + 0.1
    step = float((high - low).max() / _SHADOW_SIZE)
    height = np.full((_SHADOW_SIZE, _SHADOW_SIZE), _NOTHING, np.float32)
    return add_shadows(ShadowMap(axes, low, step, height), surfaces)


def add_shadows(shadows: ShadowMap, surfaces: Surfaces) -> ShadowMap:
    """Add the shadows of more surfaces; parts outside the grid are ignored."""
    axes, low, step, height = shadows.axes, shadows.low, shadows.step, shadows.height.copy()
    outline = (product(surfaces.corners(), axes.T)[..., :2] - low) / step
    first = np.clip(np.floor(outline.min(1)) - 1, 0, _SHADOW_SIZE).astype(int)
    last = np.clip(np.ceil(outline.max(1)) + 1, 0, _SHADOW_SIZE).astype(int)
    along = surfaces.moved(axes, np.zeros(3))
    origin, edge_u, edge_v = along.origin, along.edge_u, along.edge_v
    across = edge_u[:, 0] * edge_v[:, 1] - edge_u[:, 1] * edge_v[:, 0]
    for index in np.flatnonzero((np.abs(across) > 1e-6) & (first < last).all(1)):
        (left, top), (right, bottom) = first[index], last[index]
        x = (low[0] + (np.arange(left, right) + 0.5) * step - origin[index, 0]).astype(np.float32)
        y = (low[1] + (np.arange(top, bottom) + 0.5) * step - origin[index, 1]).astype(np.float32)
        x, y = x[None], y[:, None]
        eu, ev = edge_u[index].astype(np.float32), edge_v[index].astype(np.float32)
        area = np.float32(across[index])
        u = x * (ev[1] / area) - y * (ev[0] / area)
        v = y * (eu[0] / area) - x * (eu[1] / area)
        up = np.float32(origin[index, 2]) + u * eu[2] + v * ev[2]
        window = height[top:bottom, left:right]
        inside = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1) & (up > window)
        np.copyto(window, up, where=inside)
    return replace(shadows, height=height)


def _rgb(values: Triple) -> Float32:
    return np.array(values, np.float32)


def develop(light: Float32, frame: Frame, supersampling: int, seed: int) -> NDArray[np.uint8]:
    """Expose an image, uint8 (H, W, 3) RGB, from the light of its samples (H * ss, W * ss, 3)."""
    lighting, width, height = frame.lighting, frame.camera.width, frame.camera.height
    light = averaged(light, supersampling)
    if frame.bonnet:
        cover, paint = bonnet(width, height, seed)
        lit = _rgb(lighting.sky) + np.float32(0.4) * _rgb(lighting.sun)
        lit = lit + np.float32(0.04) * _rgb(lighting.lamps)
        light = light * (1 - cover[..., None]) + paint * cover[..., None] * lit
    signal = light * (_rgb(lighting.white_balance) * np.float32(lighting.exposure))
    x = (np.arange(width, dtype=np.float32) + 0.5) / width * 2 - 1
    y = (np.arange(height, dtype=np.float32) + 0.5) / height * 2 - 1
    squared_radius = (x[None] ** 2 + y[:, None] ** 2) / 2  # 1 in the corners
    signal *= (1 - np.float32(lighting.vignetting) * squared_radius)[..., None]
    if lighting.night:  # stray light around lamps
        haze = resized(blurred(averaged(np.minimum(signal, 4.0), 8), 3.0), width, height)
        signal = signal + np.float32(0.06) * haze
    signal = blurred(signal, lighting.blur_px)
    rng = np.random.default_rng(frame.noise_seed)
    deviation = np.sqrt(lighting.shot_noise * signal + lighting.read_noise**2)
    signal = signal + deviation * rng.standard_normal(signal.shape, dtype=np.float32)
    # compress highlights smoothly instead of clipping them, then apply gamma 2
    signal = np.clip(signal, 0, None)
    signal = np.where(signal > 0.7, 1 - 0.3 * exp(-(signal - 0.7) / 0.3), signal)
    return np.clip(np.sqrt(signal) * 255 + 0.5, 0, 255).astype(np.uint8)


@lru_cache(maxsize=4)
def bonnet(width: int, height: int, seed: int) -> tuple[Float32, Float32]:
    """Return coverage (H, W), 0..1, and linear colour (H, W, 3) of the car's bonnet in a world."""
    x = (np.arange(width, dtype=np.float32) + 0.5) / width * 2 - 1
    y = (np.arange(height, dtype=np.float32) + 0.5) / height
    edge = 0.86 + 0.11 * x**2
    below = y[:, None] - edge[None]
    cover = np.clip(below * height + 0.5, 0, 1).astype(np.float32)
    rng = stream(seed, "bonnet")
    colour = rng.uniform(0.05, 0.35, 3).astype(np.float32)
    gloss = exp(-(((below - 0.035) / 0.02) ** 2)) * 0.5 + 0.6 + 1.5 * np.clip(below, 0, None)
    canvas = np.clip(colour * gloss[..., None], 0, 1).astype(np.float32)
    for side in (-0.42, 0.42):
        start = (int((0.5 + side * 0.6) * width), int(0.86 * height))
        stop = (int((0.5 + side) * width), height)
        cv2.line(canvas, start, stop, (0.02, 0.02, 0.02), max(1, height // 200), cv2.LINE_AA)
    for _ in range(40):
        spot = (int(rng.uniform(0, width)), int(rng.uniform(0.86, 1.0) * height))
        tone = float(rng.uniform(0.2, 0.5))
        cv2.circle(canvas, spot, int(rng.integers(1, 4)), (tone, tone, tone), -1, cv2.LINE_AA)
    emblem = (width // 2, int(0.9 * height))
    cv2.circle(canvas, emblem, height // 48, (0.7, 0.7, 0.7), -1, cv2.LINE_AA)
    cv2.circle(canvas, emblem, height // 80, (0.1, 0.1, 0.3), -1, cv2.LINE_AA)
    return cover, canvas


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    image: NDArray[np.uint8]  # (H, W, 3), RGB
    # (H, W), along the optical axis at pixel centres, 0 without a surface or behind the bonnet;
    # None unless requested
    depth_m: Float32 | None
    mask: NDArray[np.bool_]  # (H, W), False on the bonnet


def painted(recipes: Iterable[TextureRecipe]) -> Atlas:
    return build_atlas([recipe.paint() for recipe in recipes])


class PlaceRenderer:
    """Renderer of the frames of one place; ``seed`` determines the clouds and the bonnet."""

    def __init__(self, place: Place, *, seed: int, supersampling: int) -> None:
        self._place = place
        self._seed = seed
        self._supersampling = supersampling
        self._atlas = painted(place.recipes)
        noise = periodic_noise(stream(seed, "clouds"), _CLOUD_SIZE, cell=160, octaves=5)
        # share of light from clouds, seamless from left to right
        self._clouds = np.clip(0.5 + 0.5 * noise, 0, 1).astype(np.float32)

    def render(self, frame: Frame, *, depth: bool = False) -> RenderedFrame:
        moving_objects = moving_object_surfaces(frame.moving_objects)
        surfaces = self._place.surfaces.joined(moving_objects)
        cam_from_place = self._place.cam_from_place(frame)
        grid = sample_grid(frame.camera, self._supersampling)
        seen = visible_surfaces(surfaces, cam_from_place, grid)
        light = self._radiance(seen, moving_objects, frame.lighting, cam_from_place)
        image = develop(light, frame, self._supersampling, self._seed)
        width, height = frame.camera.width, frame.camera.height
        cover = bonnet(width, height, self._seed)[0] if frame.bonnet else np.zeros((height, width))
        mask = cover < _BONNET_COVERS
        depth_m = None
        if depth:
            if self._supersampling > 1:
                seen = visible_surfaces(surfaces, cam_from_place, sample_grid(frame.camera, 1))
            depth_m = depth_map(seen)
            depth_m[~mask] = 0
        return RenderedFrame(image, depth_m, mask)

    def _radiance(
        self, seen: Visibility, moving: Surfaces, lighting: Lighting, cam_from_place: RigidTransform
    ) -> Float32:
        """Return the linear light along each sample's ray, float32 (rows, columns, 3)."""
        surfaces = self._place.surfaces.joined(moving)
        index = np.maximum(seen.surface, 0).astype(np.int32)
        # textures are painted with gamma 2
        albedo = (sample_colour(seen, surfaces, self._atlas) * np.float32(1 / 255)) ** 2
        normals = surfaces.normals()
        ambient = 0.62 + 0.38 * normals[:, 2]
        light = np.take(ambient.astype(np.float32), index)[..., None] * _rgb(lighting.sky)
        x, y, z = _positions(seen, cam_from_place)
        if any(lighting.sun):
            shadows = cast_shadows(self._place.surfaces, lighting.sun_direction)
            shadows = add_shadows(shadows, moving)
            facing = np.clip(product(normals, np.array(lighting.sun_direction)), 0, None)
            sun = np.take(facing.astype(np.float32), index) * shadows.lit(x, y, z)
            light += sun[..., None] * _rgb(lighting.sun)
        if any(lighting.lamps):
            normal = np.take(normals.astype(np.float32), index, axis=0)
            of_lamps = _lamp_light((x, y, z), normal, self._place.lamps.astype(np.float32))
            light += of_lamps[..., None] * _rgb(lighting.lamps)
        light += np.take(surfaces.glow, index)[..., None] * _rgb(lighting.glow)
        result = albedo * light
        result[seen.surface == NO_SURFACE] = self._sky(seen, lighting, cam_from_place)
        return result

    def _sky(self, seen: Visibility, lighting: Lighting, cam_from_place: RigidTransform) -> Float32:
        rotation = cam_from_place.rotation_matrix().astype(np.float32)
        where = seen.surface == NO_SURFACE
        gx = np.broadcast_to(seen.grid.x, where.shape)[where].astype(np.float32)
        gy = np.broadcast_to(seen.grid.y, where.shape)[where].astype(np.float32)
        rays = gx[:, None] * rotation[0] + gy[:, None] * rotation[1] + rotation[2]
        azimuth = arctan2(rays[:, 1], rays[:, 0]) + np.float32(lighting.cloud_shift)
        rise = rays[:, 2] / np.sqrt(rays[:, 0] * rays[:, 0] + rays[:, 1] * rays[:, 1])
        u = np.mod(azimuth * np.float32(_CLOUD_SIZE / (2 * np.pi)), _CLOUD_SIZE)
        v = np.clip(rise, 0, 3) * np.float32(_CLOUD_SIZE / 3.2)
        seamless = np.concatenate([self._clouds, self._clouds[:, :1]], axis=1)[..., None]
        cover = bilinear(seamless, u[None], v[None])[0]
        base = _rgb(lighting.sky_colour)
        haze = exp(-3 * np.clip(rise, 0, None))[:, None] * base.mean() * np.float32(0.5)
        return base * (1 - 0.5 * cover) + cover * base.mean() * np.float32(1.1) + haze


def _positions(seen: Visibility, cam_from_place: RigidTransform) -> tuple[Float32, ...]:
    """Return x, y, z of each sample's surface point (else of the camera), in the place's frame."""
    rotation = cam_from_place.rotation_matrix().astype(np.float32)
    center = cam_from_place.center().astype(np.float32)
    hit = seen.inverse_depth > 0
    depth = np.where(hit, 1 / np.where(hit, seen.inverse_depth, 1), 0).astype(np.float32)
    gx, gy = seen.grid.x.astype(np.float32), seen.grid.y.astype(np.float32)
    return tuple(
        center[i] + depth * (rotation[0, i] * gx + rotation[1, i] * gy + rotation[2, i])
        for i in range(3)
    )


def _lamp_light(position: tuple[Float32, ...], normal: Float32, lamps: Float32) -> Float32:
    """Sum cosine / squared distance over all lamps, cut off smoothly at _LAMP_RANGE_M."""
    total = np.zeros_like(position[0])
    for lamp in lamps:
        dx, dy, dz = (lamp[i] - position[i] for i in range(3))
        squared = dx * dx + dy * dy + dz * dz
        facing = dx * normal[..., 0] + dy * normal[..., 1] + dz * normal[..., 2]
        fade = np.clip(1 - squared * np.float32(_LAMP_RANGE_M**-2), 0, None)
        total += np.clip(facing, 0, None) * fade / (squared * np.sqrt(squared) + np.float32(0.3))
    return total


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
    """Render every frame and pass it to ``finish``; return the results by image name.

    ``finish`` must be picklable and is called in the process that rendered the frame. The frames
    named in ``with_depth`` have ``depth_m``. ``sky_seed``, by default the world's seed, determines
    the clouds and the look of the bonnet.
    """
    seed = options.seed if sky_seed is None else sky_seed
    render = partial(_render, options, build, seed, frozenset(with_depth), finish)
    results = chain.from_iterable(ordered_map(render, _batches(frames), work.executor))
    return dict(sorted(work.track(results, len(frames), "drawing"), key=itemgetter(0)))


def _batches(frames: Sequence[Frame]) -> Iterator[list[Frame]]:
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


def render_map_and_queries(
    options: TwinOptions, mapping: list[Frame], others: list[Frame], images: Path, work: Work
) -> dict[str, Float32]:
    """Render all frames, write them by name below ``images`` and return the map images' depths."""
    names, finish = [frame.name for frame in mapping], partial(_write, images)
    drawn = render_frames(options.world(), mapping + others, finish, with_depth=names, work=work)
    return {name: depth for name, depth in drawn.items() if depth is not None}


def _write(images: Path, frame: Frame, view: RenderedFrame) -> Float32 | None:
    write_image(images / frame.name, view.image, jpeg_quality=JPEG_QUALITY)
    return view.depth_m

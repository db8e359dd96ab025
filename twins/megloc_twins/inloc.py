"""A rendered twin of InLoc: scans of two floors alike, and telephones' images."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.datasets.inloc.layout import COLOURS, POINTS
from megloc_kapture.datasets.official import GROUND_TRUTH
from megloc_kapture.io.dataset_tables import SIDE_TABLES, ImageGroup, write_groups
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import write_sensors
from megloc_kapture.io.mat_file import write_mat_arrays
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Camera, Options, RigidTransform
from megloc_twins.dataset import SyntheticDataset
from megloc_twins.frames import Frame, kapture_records, noise_seed
from megloc_twins.indoor_floors import (
    PITCHES_DEG,
    YAWS_DEG,
    Floor,
    FloorBuilder,
    cam_from_scan,
    cutout_camera,
    lamp_lighting,
    query_views,
)
from megloc_twins.model_files import write_transformation
from megloc_twins.options import SyntheticWorldOptions, stream
from megloc_twins.portable import product, settled
from megloc_twins.rasterization import NO_SURFACE, sample_grid, visible_surfaces
from megloc_twins.render import RenderedFrame, render_frames

_RANGE_M = 18.0
_RANGE_NOISE_M = 0.001
_MIN_COSINE = 0.06  # a beam that grazes a surface does not come back
_DARK = 24.0  # mean of the channels, 0..255; less swallows the beam
_DROPOUTS = 0.02  # share of pixels without a return, for no reason

_FLOORS = ("DUC1", "DUC2")
_BUILDING = "DUC"
_FIRST_QUERY = 801  # of the numbers the telephone gave its images
_JPEG_QUALITY = 92


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


class InLocTwinOptions(Options):
    """Contents of InLoc's twin; the defaults are what ``make eval`` localizes in."""

    seed: int = Field(default=0, ge=0, description="every random choice hangs on it")
    modules: int = Field(
        default=2, ge=1, le=20, description="pieces of corridor per floor, two rooms on each"
    )
    queries: int = Field(default=48, ge=2, description="query images, both floors")
    cutout_width: int = Field(default=400, ge=40, description="in px")
    cutout_height: int = Field(default=300, ge=30, description="in px")
    query_width: int = Field(default=640, ge=64, description="of those not held upright, in px")
    query_height: int = Field(default=480, ge=48, description="in px")
    supersampling: int = Field(
        default=2, ge=1, le=4, description="samples of queries per px and axis; of cutouts one"
    )

    def world(self, supersampling: int = 1) -> SyntheticWorldOptions:
        """The options that the renderer and random streams know."""
        return SyntheticWorldOptions(
            seed=self.seed, num_places=len(_FLOORS), supersampling=supersampling
        )

    def builder(self) -> FloorBuilder:
        """The builder of the floors."""
        return FloorBuilder(self.modules)


class InLocTwin(SyntheticDataset[InLocTwinOptions]):
    """InLoc as it is published, with its truth.

    ``database/`` (cutouts with their points, transformations), ``query/`` and ``ground_truth/``.
    """

    Options = InLocTwinOptions
    version = 2

    def write(self, root: Path, work: Work = HERE) -> dict[str, int]:
        root, options = Path(root), self.options
        scans = _scans(options)
        mapping = [frame for scan in scans for frame in _cutouts(options, scan)]
        queries = _queries(options)
        for frames, samples in ((mapping, 1), (queries, options.supersampling)):
            render_frames(
                options.world(samples),
                frames,
                partial(_write_files, root, options),
                build=options.builder(),
                work=work,
            )
        for scan in scans:
            after = scan.scan_from_floor.inverse()
            rng = stream(options.seed, "inloc", "before", scan.transformation)
            write_transformation(root / scan.transformation, _displaced(after, rng), after)
        truth = root / GROUND_TRUTH
        write_sensors(truth / "mapping", kapture_records(mapping))
        write_sensors(truth / "query", kapture_records(queries))
        groups = {frame.name: ImageGroup(condition=frame.condition) for frame in queries}
        write_groups(truth / SIDE_TABLES, groups)
        return {
            "floors": len(_FLOORS),
            "scans": len(scans),
            "mapping images": len(mapping),
            "query images": len(queries),
        }


@dataclass(frozen=True)
class _Scan:
    """A scan of the twin: what its files are called and where it stands."""

    floor: int
    number: str
    scan_from_floor: RigidTransform

    @property
    def transformation(self) -> str:
        return (
            f"database/alignments/{_FLOORS[self.floor]}/transformations/"
            f"{_BUILDING}_trans_{self.number}.txt"
        )

    def image(self, yaw_deg: int, pitch_deg: int) -> str:
        name = f"{_BUILDING}_cutout_{self.number}_{yaw_deg}_{pitch_deg}.jpg"
        return f"database/cutouts/{_FLOORS[self.floor]}/{self.number}/{name}"


def _scans(options: InLocTwinOptions) -> list[_Scan]:
    scans = []
    for index in range(len(_FLOORS)):
        floor = options.builder().floor(options.seed, index)
        for number, zone in enumerate(floor.zones):
            pose = zone.scan_from_place @ floor.place.place_from_world
            scans.append(_Scan(index, f"{number:03d}", pose))
    return scans


def _cutouts(options: InLocTwinOptions, scan: _Scan) -> list[Frame]:
    world = options.world()
    frames: list[Frame] = []
    camera = cutout_camera(options.cutout_width, options.cutout_height)
    for yaw in YAWS_DEG:
        for pitch in PITCHES_DEG:
            name = scan.image(yaw, pitch)
            # one exposure for the whole panorama
            rng = stream(options.seed, "inloc", "light", scan.transformation)
            frames.append(
                Frame(
                    name=name,
                    role="mapping",
                    condition=_FLOORS[scan.floor],
                    place=scan.floor,
                    timestamp=len(frames) + 1000 * int(scan.number) + 1_000_000 * scan.floor,
                    sensor_id="cutout",
                    camera=camera,
                    cam_from_world=cam_from_scan(yaw, pitch) @ scan.scan_from_floor,
                    lighting=lamp_lighting(rng, noise=1.0, noise_seed=noise_seed(world, name)),
                    moving_objects=(),
                    bonnet=False,
                )
            )
    return frames


def _queries(options: InLocTwinOptions) -> list[Frame]:
    world = options.world()
    floors = options.builder().floors(options.seed, len(_FLOORS))
    size = options.query_width, options.query_height
    frames = []
    for number, view in enumerate(query_views(floors, options.seed, options.queries, size)):
        name = f"query/iphone7/IMG_{_FIRST_QUERY + number:04d}.JPG"
        rng = stream(options.seed, "inloc", "light", name)
        seed = noise_seed(world, name)
        place_from_world = floors[view.floor].place.place_from_world
        frames.append(
            Frame(
                name=name,
                role="query",
                condition=_FLOORS[view.floor],
                place=view.floor,
                timestamp=number,
                sensor_id="upright" if view.camera.height > view.camera.width else "iphone7",
                camera=view.camera,
                cam_from_world=view.cam_from_place @ place_from_world,
                lighting=lamp_lighting(rng, noise=3.0, noise_seed=seed, spread=0.15),
                moving_objects=view.people,
                bonnet=False,
            )
        )
    return frames


def _displaced(pose: RigidTransform, rng: np.random.Generator) -> RigidTransform:
    """A scan's pose before its refinement: beside the true one, turned a bit."""
    half = 0.5 * float(rng.normal(0, 0.02))
    w, z = settled((np.cos(half), np.sin(half))).tolist()
    turn = RigidTransform((w, 0.0, 0.0, z), (0.0, 0.0, 0.0))
    x, y, z = (float(v) for v in rng.normal(0, 0.08, 3))
    return RigidTransform((1.0, 0.0, 0.0, 0.0), (x, y, z)) @ pose @ turn


def _write_files(root: Path, options: InLocTwinOptions, frame: Frame, view: RenderedFrame) -> None:
    """A frame's image and, of a cutout, what the scanner measured in its pixels."""
    write_image(root / frame.name, view.image, jpeg_quality=_JPEG_QUALITY)
    if frame.role == "query":
        return
    floor = options.builder().floor(options.seed, frame.place)
    yaw, pitch = (int(text) for text in PurePosixPath(frame.name).stem.split("_")[-2:])
    points = scanned_points(
        floor,
        frame.camera,
        frame.cam_from_world @ floor.place.place_from_world.inverse(),
        cam_from_scan(yaw, pitch),
        view.image,
        stream(options.seed, "inloc", "laser", frame.name),
    )
    write_mat_arrays(root / f"{frame.name}.mat", {COLOURS: view.image, POINTS: points})

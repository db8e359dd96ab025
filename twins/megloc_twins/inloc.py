"""A rendered twin of InLoc: laser scans of two similar floors, and phone images."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import partial
from io import BytesIO
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import Field
from scipy.io import savemat

from megloc_kapture.datasets.inloc.adapter import POINTS
from megloc_kapture.datasets.official import GROUND_TRUTH
from megloc_kapture.io.dataset_tables import SIDE_TABLES, ImageGroup, SideTables, write_side_tables
from megloc_kapture.io.files import write_bytes
from megloc_kapture.io.images import write_image
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Camera, RigidTransform
from megloc_twins.frames import Frame, lamp_lighting, write_truth
from megloc_twins.indoor_rooms import MODULE_M, Floor, Zone, build_floor, floor_place
from megloc_twins.moving_objects import NUM_PEOPLE, MovingObject
from megloc_twins.options import JPEG_QUALITY, SyntheticDataset, TwinOptions, stream, write_lines
from megloc_twins.portable import Bools, Float64, looking_at, product, settled
from megloc_twins.rasterization import NO_SURFACE, sample_grid, visible_surfaces
from megloc_twins.render import RenderedFrame, render_frames
from megloc_twins.viewpoints import CoarseView, coarse_view, first_fitting, visible

YAWS_DEG = tuple(range(0, 360, 30))
PITCHES_DEG = (-30, 0, 30)

_RANGE_M = 18.0
_RANGE_NOISE_M = 0.001
_MIN_COSINE = 0.06  # beams at a more grazing angle do not return
_DARK = 24.0  # mean of the channels, 0..255; darker pixels absorb the beam
_DROPOUTS = 0.02  # share of pixels without a return, at random

_FLOORS = ("DUC1", "DUC2")
_FIRST_QUERY = 801  # number of the first phone image

_REDUCTION = 20  # of the resolution, to test a query pose
_ATTEMPTS = 400
_WALL_DISTANCE_M = 0.7
_NEAREST_M, _MEDIAN_M = 0.7, 1.6  # depth in a query's view: 10th percentile, median
# smallest share of a query's view that scans of its floor saw from a similar viewpoint, and its
# smallest difference from the share seen by scans of other rooms of the same kind
_MIN_SEEN, _MIN_MARGIN = 0.6, 0.2
# field of view 90 degrees wide, 106 high
_QUARTER = Camera("SIMPLE_PINHOLE", 240, 320, (120.0, 120.0, 160.0))
_MAX_ANGLE_DEG, _MAX_DISTANCE_RATIO = 35.0, 2.0

# centres of a floor's scanners, and their views in all directions, up to the height of the cutouts
Scans = list[tuple[Float64, list[CoarseView]]]


class InLocTwinOptions(TwinOptions):
    """Contents of InLoc's twin; ``make eval`` uses the defaults."""

    modules: int = Field(default=2, ge=1, le=20, description="corridor sections, two rooms each")
    queries: int = Field(default=48, ge=2, description="query images, in total")
    cutout_width: int = Field(default=400, ge=40, description="width of cutouts in px")
    cutout_height: int = Field(default=300, ge=30, description="height of cutouts in px")
    query_width: int = Field(default=640, ge=64, description="width of landscape queries in px")
    query_height: int = Field(default=480, ge=48, description="height of landscape queries in px")
    supersampling: int = Field(default=2, ge=1, le=4, description="samples per axis; cutouts: 1")

    def floors(self) -> list[Floor]:
        return [build_floor(self.seed, index, self.modules) for index in range(len(_FLOORS))]


class InLocTwin(SyntheticDataset[InLocTwinOptions]):
    """InLoc in its published layout, with true poses.

    ``database/`` (cutouts with their points, transformations), ``query/`` and ``ground_truth/``.
    """

    Options = InLocTwinOptions
    version = 2

    def write(self, root: Path, work: Work = HERE) -> dict[str, int]:
        root, options = Path(root), self.options
        mapping: list[Frame] = []
        queries = list(build_queries(options))
        for index, floor in enumerate(options.floors()):
            for number, zone in enumerate(floor.zones):
                scan_from_floor = zone.scan_from_place @ floor.place.place_from_world
                mapping += _cutouts(options, index, number, scan_from_floor)
                name = _transformation(index, number)
                rng = stream(options.seed, "inloc", "before", name)
                _write_transformation(root / name, scan_from_floor.inverse(), rng)
        finish, build = partial(_write_files, root, options), partial(floor_place, options.modules)
        cutouts = options.world().model_copy(update={"supersampling": 1})
        render_frames(cutouts, mapping, finish, build=build, work=work)
        render_frames(options.world(), queries, finish, build=build, work=work)
        groups = {frame.name: ImageGroup(condition=frame.condition) for frame in queries}
        write_side_tables(root / GROUND_TRUTH / SIDE_TABLES, SideTables(groups=groups))
        scans = len(mapping) // (len(YAWS_DEG) * len(PITCHES_DEG))
        return {"floors": len(_FLOORS), "scans": scans} | write_truth(root, mapping, queries)


def _transformation(floor: int, number: int) -> str:
    return f"database/alignments/{_FLOORS[floor]}/transformations/DUC_trans_{number:03d}.txt"


def _cutouts(
    options: InLocTwinOptions, floor: int, number: int, scan_from_floor: RigidTransform
) -> Iterator[Frame]:
    camera = cutout_camera(options.cutout_width, options.cutout_height)
    folder = f"database/cutouts/{_FLOORS[floor]}/{number:03d}"
    # a panorama has a single exposure
    rng = stream(options.seed, "inloc", "light", _transformation(floor, number))
    lighting = lamp_lighting(rng, noise=1.0)
    for view, (yaw, pitch) in enumerate(itertools.product(YAWS_DEG, PITCHES_DEG)):
        name = f"{folder}/DUC_cutout_{number:03d}_{yaw}_{pitch}.jpg"
        yield Frame(
            name=name,
            condition=_FLOORS[floor],
            place=floor,
            timestamp=view + 1000 * number + 1_000_000 * floor,
            sensor_id="cutout",
            camera=camera,
            cam_from_world=cam_from_scan(yaw, pitch) @ scan_from_floor,
            lighting=lighting,
            noise_seed=options.noise_seed(name),
        )


def _write_transformation(path: Path, pose: RigidTransform, rng: Generator) -> None:
    """Write a scan's pose before refinement, slightly displaced and rotated, and after it."""
    half = 0.5 * float(rng.normal(0, 0.02))
    w, z = settled((np.cos(half), np.sin(half))).tolist()
    turn = RigidTransform((w, 0.0, 0.0, z), (0.0, 0.0, 0.0))
    x, y, z = (float(v) for v in rng.normal(0, 0.08, 3))
    before = RigidTransform((1.0, 0.0, 0.0, 0.0), (x, y, z)) @ pose @ turn
    lines = []
    for heading, matrix in (("Before", before.matrix()), ("After", pose.matrix())):
        rows = (" ".join(f"{value:13.9f}" for value in row) for row in matrix)
        lines += [f"{heading} general icp:", *rows, ""]
    write_lines(path, lines, last_line_ends=False)


def _write_files(root: Path, options: InLocTwinOptions, frame: Frame, view: RenderedFrame) -> None:
    write_image(root / frame.name, view.image, jpeg_quality=JPEG_QUALITY)
    if frame.sensor_id != "cutout":
        return
    floor = build_floor(options.seed, frame.place, options.modules)
    yaw, pitch = (int(text) for text in PurePosixPath(frame.name).stem.split("_")[-2:])
    poses = floor.place.cam_from_place(frame), cam_from_scan(yaw, pitch)
    rng = stream(options.seed, "inloc", "laser", frame.name)
    points = scanned_points(floor, frame.camera, *poses, view.image, rng)
    content = BytesIO()
    savemat(content, {"RGBcut": view.image, POINTS: points}, do_compression=True)
    header = b"MATLAB 5.0 MAT-file".ljust(116)  # SciPy's header contains the date
    write_bytes(root / f"{frame.name}.mat", header + content.getvalue()[len(header) :])


def scanned_points(
    floor: Floor,
    camera: Camera,
    cam_from_place: RigidTransform,
    cam_from_scan: RigidTransform,
    image: NDArray[np.uint8],
    rng: Generator,
) -> Float64:
    """Return the scanned point of each pixel of a cutout, (H, W, 3), metres in the scan's frame.

    Pixels without a return are NaN: on glass, where ``image``, uint8 (H, W, 3), is dark, far away,
    at grazing angles and at random. The noise is a millimetre along the beam. Values are rounded to
    float32, as in the official files.
    """
    grid = sample_grid(camera, 1)
    seen = visible_surfaces(floor.place.surfaces, cam_from_place, grid)
    surface, rays = np.maximum(seen.surface, 0), grid.rays()
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


def cam_from_scan(yaw_deg: float, pitch_deg: float) -> RigidTransform:
    """Return a cutout's pose in its scan (z up): -x is forward at yaw 0, positive yaw is right."""
    return looking_at(np.zeros(3), np.pi - np.radians(yaw_deg), np.radians(pitch_deg), 0.0)


def cutout_camera(width: int, height: int) -> Camera:
    """Return a cutout's camera, with a horizontal field of view of 60 degrees."""
    return Camera.pinhole(width, height, float(width / 2 / np.tan(np.radians(30.0))))


def phone_camera(width: int, height: int) -> Camera:
    """Return a phone's camera with a 28 mm lens (36 mm film)."""
    return Camera.pinhole(width, height, max(width, height) * 28 / 36)


def build_queries(options: InLocTwinOptions) -> Iterator[Frame]:
    """Yield phone images, floor by floor and zone by zone; a third of them in portrait format.

    A query gets the first of up to 400 random poses whose view is covered well by the floor's
    scans, and better than the corresponding view is by scans of similar rooms; else the pose that
    comes closest.
    """
    floors = options.floors()
    scans = [[_scan_views(floor, zone) for zone in floor.zones] for floor in floors]
    size = options.query_width, options.query_height
    for index, floor in enumerate(floors):
        first, last = (options.queries * number // len(floors) for number in (index, index + 1))
        for position in range(last - first):
            zone = floor.zones[position % len(floor.zones)]
            rng = stream(options.seed, "indoor", "query", index, position)
            upright = (position + position // len(floor.zones)) % 3 == 2
            camera = phone_camera(*(size[::-1] if upright else size))
            pose, yaw = first_fitting(_query_poses(floors, index, zone, camera, scans, rng))
            name = f"query/iphone7/IMG_{_FIRST_QUERY + first + position:04d}.JPG"
            light = stream(options.seed, "inloc", "light", name)
            yield Frame(
                name=name,
                condition=_FLOORS[index],
                place=index,
                timestamp=first + position,
                sensor_id="upright" if camera.height > camera.width else "iphone7",
                camera=camera,
                cam_from_world=pose @ floor.place.place_from_world,
                lighting=lamp_lighting(light, noise=3.0, spread=0.15),
                noise_seed=options.noise_seed(name),
                moving_objects=tuple(_people(zone, pose, yaw, rng)),
            )


def _query_poses(
    floors: list[Floor], index: int, zone: Zone, camera: Camera, scans: list[Scans], rng: Generator
) -> Iterator[tuple[float, tuple[RigidTransform, float]]]:
    """Yield misfit, pose and yaw of random poses in a zone; worse ones are mostly skipped."""
    floor, plan = floors[index], zone.plan
    copies = list(_copies(floors, index, zone))
    least = np.inf
    for _ in range(_ATTEMPTS):
        x, y = (float(v) for v in rng.uniform(plan.outline.min(axis=0), plan.outline.max(axis=0)))
        yaw = float(rng.uniform(-np.pi, np.pi))
        pitch, roll = float(rng.normal(-0.05, 0.1)), float(rng.normal(0, 0.05))
        position = np.array([x, y, rng.uniform(1.4, 1.75)])
        if not plan.is_free(x, y, _WALL_DISTANCE_M):
            continue
        pose = looking_at(position, yaw, pitch, roll)
        view = coarse_view(floor.place.surfaces, camera, pose, reduction=_REDUCTION, stride=1)
        depth, points = view.depth[view.depth > 0].astype(np.float64), view.points
        if np.percentile(depth, 10) < _NEAREST_M or np.median(depth) < _MEDIAN_M:
            continue
        matt = ~floor.glass[view.surface]
        seen = float((_have_seen(scans[index], points, position) & matt).mean())
        miss = max(0.0, _MIN_SEEN - seen)
        if miss >= least:
            continue
        common = ~floor.own[view.surface] & matt
        for other, moved in copies:
            again = _have_seen(scans[other], moved.apply(points), moved.apply(position))
            alike = float((again & common).mean())
            miss = max(miss, _MIN_MARGIN - (seen - alike))
        least = min(least, miss)
        yield miss, (pose, yaw)


def _copies(floors: list[Floor], index: int, zone: Zone) -> Iterator[tuple[int, RigidTransform]]:
    """Yield floor and transform to each zone of the same kind; for corridors also a half turn."""
    half_turn = RigidTransform((0.0, 0.0, 0.0, 1.0), (MODULE_M, 0.0, 0.0))
    for other_index, floor in enumerate(floors):
        for other in floor.zones:
            if other.kind != zone.kind:
                continue
            if (other_index, other.name) != (index, zone.name):
                yield other_index, other.place_from_zone @ zone.place_from_zone.inverse()
            if zone.kind == "corridor":
                turned = other.place_from_zone @ half_turn @ zone.place_from_zone.inverse()
                yield other_index, turned


def _scan_views(floor: Floor, zone: Zone) -> tuple[Float64, list[CoarseView]]:
    poses = [cam_from_scan(yaw, 0) @ zone.scan_from_place for yaw in (0, 90, 180, 270)]
    views = [coarse_view(floor.place.surfaces, _QUARTER, pose) for pose in poses]
    return zone.scan_from_place.center(), views


def _have_seen(scans: Scans, points: Float64, position: Float64) -> Bools:
    """Select points (P, 3) that a scan saw from a viewpoint similar to ``position`` (3,)."""
    found = np.zeros(len(points), bool)
    here = points - position
    distance = np.linalg.norm(here, axis=1)
    for center, views in scans:
        there = points - center
        other = np.linalg.norm(there, axis=1)
        cosine = (here * there).sum(axis=1) / (distance * other)
        near = np.abs(np.log(distance / other)) < np.log(_MAX_DISTANCE_RATIO)
        alike = near & (cosine > np.cos(np.radians(_MAX_ANGLE_DEG))) & ~found
        if alike.any():
            found[alike] = np.any([visible(points[alike], view) for view in views], axis=0)
    return found


def _people(zone: Zone, pose: RigidTransform, yaw: float, rng: Generator) -> list[MovingObject]:
    """Place up to two people in front of the phone, in half of the images."""
    people: list[MovingObject] = []
    wanted = int(rng.integers(0, 4)) - 1
    x0, y0, _ = pose.center()
    for _ in range(20):
        if len(people) >= wanted:
            break
        distance, angle = rng.uniform(1.8, 3.5), yaw + rng.uniform(-0.5, 0.5)
        x, y = float(x0 + distance * np.cos(angle)), float(y0 + distance * np.sin(angle))
        if zone.plan.is_free(x, y, 0.3):
            turn = float(rng.uniform(-np.pi, np.pi))
            people.append(MovingObject("person", int(rng.integers(NUM_PEOPLE)), (x, y), turn))
    return people

"""A rendered twin of InLoc: two floors alike, in the official layout, with their truth."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from pydantic import Field

from megloc_kapture.datasets.formats.inloc_files import COLOURS, POINTS, write_transformation
from megloc_kapture.datasets.official import GROUND_TRUTH
from megloc_kapture.datasets.synthetic.indoor_floors import FloorBuilder
from megloc_kapture.datasets.synthetic.indoor_queries import query_views
from megloc_kapture.datasets.synthetic.indoor_scans import scanned_points
from megloc_kapture.datasets.synthetic.indoor_shots import (
    PITCHES_DEG,
    YAWS_DEG,
    cam_from_scan,
    cutout_camera,
    lamp_light,
)
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions, stream
from megloc_kapture.datasets.synthetic.portable import settled
from megloc_kapture.datasets.synthetic.shots import Shot, noise_seed
from megloc_kapture.datasets.synthetic.studio import draw_shots
from megloc_kapture.datasets.synthetic.views import View
from megloc_kapture.io.dataset_tables import SIDE_TABLES, ImageGroup, write_groups
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.io.mat_file import write_mat_arrays
from megloc_kapture.stages.work import Track, untracked
from megloc_kapture.values import Options, RigidTransform

# raise when the same options draw other pixels or other files than before
INLOC_TWIN_VERSION = 2

_FLOORS = ("DUC1", "DUC2")
_BUILDING = "DUC"
_FIRST_QUERY = 801  # of the numbers the telephone gave its images
_JPEG_QUALITY = 92


class InLocTwinOptions(Options):
    """What the twin contains. The defaults are what ``make eval DATASET=synthetic-inloc`` runs."""

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
        """The options that the painter and random streams know."""
        return SyntheticWorldOptions(
            seed=self.seed, num_places=len(_FLOORS), supersampling=supersampling
        )

    def builder(self) -> FloorBuilder:
        """What lays out the floors."""
        return FloorBuilder(self.modules)


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


def write_inloc_twin(
    root: Path,
    options: InLocTwinOptions | None = None,
    executor: Executor | None = None,
    *,
    track: Track = untracked,
) -> dict[str, int]:
    """Draw the twin and write it as InLoc is published; returns what it holds.

    Below ``root``: ``database/`` (cutouts with their points, transformations), ``query/`` and
    ``ground_truth/``. The bytes depend on the options only, not on the executor.

    Parameters
    ----------
    executor : shares the drawing among processes that see the same file system.
    track : shows progress, image by image.

    Raises
    ------
    OutputError : something cannot be written.
    """
    root, options = Path(root), options or InLocTwinOptions()
    scans = _scans(options)
    mapping = [shot for scan in scans for shot in _cutouts(options, scan)]
    queries = _queries(options)
    for shots, samples in ((mapping, 1), (queries, options.supersampling)):
        draw_shots(
            options.world(samples),
            shots,
            partial(_write_files, root, options),
            build=options.builder(),
            executor=executor,
            track=track,
        )
    for scan in scans:
        after = scan.scan_from_floor.inverse()
        rng = stream(options.seed, "inloc", "before", scan.transformation)
        write_transformation(root / scan.transformation, _displaced(after, rng), after)
    truth = root / GROUND_TRUTH
    write_sensors(truth / "mapping", _with_poses(mapping))
    write_sensors(truth / "query", _with_poses(queries))
    groups = {shot.name: ImageGroup(condition=shot.condition) for shot in queries}
    write_groups(truth / SIDE_TABLES, groups)
    return {
        "floors": len(_FLOORS),
        "scans": len(scans),
        "mapping images": len(mapping),
        "query images": len(queries),
    }


def _scans(options: InLocTwinOptions) -> list[_Scan]:
    scans = []
    for index in range(len(_FLOORS)):
        floor = options.builder().floor(options.seed, index)
        for number, zone in enumerate(floor.zones):
            pose = zone.scan_from_place @ floor.place.place_from_world
            scans.append(_Scan(index, f"{number:03d}", pose))
    return scans


def _cutouts(options: InLocTwinOptions, scan: _Scan) -> list[Shot]:
    world = options.world()
    shots: list[Shot] = []
    camera = cutout_camera(options.cutout_width, options.cutout_height)
    for yaw in YAWS_DEG:
        for pitch in PITCHES_DEG:
            name = scan.image(yaw, pitch)
            # one exposure for the whole panorama
            rng = stream(options.seed, "inloc", "light", scan.transformation)
            shots.append(
                Shot(
                    name=name,
                    role="mapping",
                    condition=_FLOORS[scan.floor],
                    place=scan.floor,
                    timestamp=len(shots) + 1000 * int(scan.number) + 1_000_000 * scan.floor,
                    sensor_id="cutout",
                    camera=camera,
                    cam_from_world=cam_from_scan(yaw, pitch) @ scan.scan_from_floor,
                    look=lamp_light(rng, noise=1.0, noise_seed=noise_seed(world, name)),
                    movers=(),
                    bonnet=False,
                )
            )
    return shots


def _queries(options: InLocTwinOptions) -> list[Shot]:
    world = options.world()
    floors = options.builder().floors(options.seed, len(_FLOORS))
    size = options.query_width, options.query_height
    shots = []
    for number, view in enumerate(query_views(floors, options.seed, options.queries, size)):
        name = f"query/iphone7/IMG_{_FIRST_QUERY + number:04d}.JPG"
        rng = stream(options.seed, "inloc", "light", name)
        seed = noise_seed(world, name)
        place_from_world = floors[view.floor].place.place_from_world
        shots.append(
            Shot(
                name=name,
                role="query",
                condition=_FLOORS[view.floor],
                place=view.floor,
                timestamp=number,
                sensor_id="upright" if view.camera.height > view.camera.width else "iphone7",
                camera=view.camera,
                cam_from_world=view.cam_from_place @ place_from_world,
                look=lamp_light(rng, noise=3.0, noise_seed=seed, spread=0.15),
                movers=view.people,
                bonnet=False,
            )
        )
    return shots


def _displaced(pose: RigidTransform, rng: np.random.Generator) -> RigidTransform:
    """Where a scan was thought to stand before its refinement: beside its place, turned a bit."""
    half = 0.5 * float(rng.normal(0, 0.02))
    w, z = settled((np.cos(half), np.sin(half))).tolist()
    turn = RigidTransform((w, 0.0, 0.0, z), (0.0, 0.0, 0.0))
    x, y, z = (float(v) for v in rng.normal(0, 0.08, 3))
    return RigidTransform((1.0, 0.0, 0.0, 0.0), (x, y, z)) @ pose @ turn


def _with_poses(shots: Sequence[Shot]) -> KaptureData:
    """Sensors, records and true poses of the shots, in their floors' frames."""
    data = KaptureData()
    for shot in shots:
        data.sensors[shot.sensor_id] = Sensor.from_camera(shot.camera, name=shot.sensor_id)
        data.records_camera[shot.timestamp, shot.sensor_id] = shot.name
        data.trajectories[shot.timestamp, shot.sensor_id] = shot.cam_from_world
    return data


def _write_files(root: Path, options: InLocTwinOptions, shot: Shot, view: View) -> None:
    """A shot's image and, of a cutout, what the scanner measured in its pixels."""
    write_image(root / shot.name, view.image, jpeg_quality=_JPEG_QUALITY)
    if shot.role == "query":
        return
    floor = options.builder().floor(options.seed, shot.place)
    yaw, pitch = (int(text) for text in PurePosixPath(shot.name).stem.split("_")[-2:])
    points = scanned_points(
        floor,
        shot.camera,
        shot.cam_from_world @ floor.place.place_from_world.inverse(),
        cam_from_scan(yaw, pitch),
        view.image,
        stream(options.seed, "inloc", "laser", shot.name),
    )
    write_mat_arrays(root / f"{shot.name}.mat", {COLOURS: view.image, POINTS: points})

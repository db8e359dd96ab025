"""Stages: matching of photographs without poses, and structure from motion by COLMAP."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from megloc_kapture.errors import DataError, require
from megloc_kapture.geometry.poses import GeoPosition, align_to_earth
from megloc_kapture.io.colmap_mapping import Mapper, Model, Photograph, reconstruct
from megloc_kapture.io.dataset_tables import (
    METRES,
    NO_METRES,
    SIDE_TABLES,
    UNREGISTERED_FILE,
    WORLD_FILE,
    World,
    read_unreadable,
    write_unreadable,
    write_world,
)
from megloc_kapture.io.files import link_images
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.io.tables import read_match_counts
from megloc_kapture.matching.verification import agree_by_chance
from megloc_kapture.stages import paths
from megloc_kapture.stages.map_points import matched_pairs, matches_of
from megloc_kapture.stages.matches import MATCHING_OPTIONS, MatchMapping, Verification
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.stage import LOCAL_TYPES, PipelineStage, StageWork
from megloc_kapture.values import Options, RigidTransform

_UNTURNED = RigidTransform.identity()

_log = logging.getLogger(__name__)


class StructureOptions(Options):
    """Options of structure from motion, and the source of the metric scale.

    Attributes
    ----------
    distance : two images and the distance between their camera centres in metres.
    gps : latitude and longitude in degrees and height in metres, by image.
    """

    mapper: Mapper = "incremental"
    known_cameras: bool = False
    distance: tuple[str, str, float] | None = None
    gps: dict[str, GeoPosition] | None = None
    seed: int = Field(default=0, ge=0)


class MatchPhotographs(MatchMapping):
    """Match photographs without poses and verify the matches by a two-view model."""

    name = "photograph_matches"
    uses = (*MATCHING_OPTIONS, "query_verification")
    outputs = (paths.PHOTOGRAPH_MATCHES,)

    def verification(self) -> Verification:
        return self.options.verify_photographs()


class FindPoses(PipelineStage):
    """Estimate poses and cameras of matched photographs; the largest model becomes the map."""

    name = "poses"
    version = 3
    uses = (*LOCAL_TYPES, "query_verification")
    inputs = (PipelineStage.mapping, SIDE_TABLES, paths.LOCAL_FEATURES, paths.PHOTOGRAPH_MATCHES)
    outputs = (paths.POSED, f"{SIDE_TABLES}/{WORLD_FILE}", f"{SIDE_TABLES}/{UNREGISTERED_FILE}")

    def __init__(self, options: PipelineOptions, structure: StructureOptions) -> None:
        super().__init__(options)
        self._structure = structure

    def settings(self) -> dict[str, Any]:
        return {**super().settings(), "structure": self._structure.model_dump(mode="json")}

    def run(self, work: StageWork) -> Mapping[str, float]:
        mapping = work.folder(self.mapping(), paths.FEATURES, paths.PHOTOGRAPH_MATCHES)
        data, structure = mapping.read(), self._structure
        models = self._models(work, mapping, data)
        world, model, counts = _scaled(models[0], structure)
        if separate := sorted(
            i for i, sensor in model.sensors.items() if sensor not in data.sensors
        ):
            message = (
                "%d photographs have the same size as others, but a different camera (zoom or "
                "crop): %s"
            )
            _log.warning(message, len(separate), ", ".join(separate))
        tables = work.out / SIDE_TABLES
        reasons = read_unreadable(work.path(SIDE_TABLES))
        absent = set(data.image_names()) - model.poses.keys()
        reasons |= dict.fromkeys(sorted(absent), "no model: too few matches agree")
        for number, other in enumerate(models[1:], start=2):
            reasons |= {
                image: f"model {number}, of {len(other.poses)} photographs, which is not "
                "connected to the map"
                for image in other.poses.keys() - model.poses.keys()
            }
        write_unreadable(tables, reasons, UNREGISTERED_FILE)
        write_world(tables, world)
        write_posed(work.out / paths.POSED, data, model)
        link_images(mapping.root, work.out / paths.POSED)
        return {
            "photographs": len(data.image_names()) + len(read_unreadable(work.path(SIDE_TABLES))),
            "with_a_pose": len(model.poses),
            "models": len(models),
            "cameras": len(model.cameras),
            "points": model.num_points,
            "mean_reprojection_error_px": round(model.error_px, 4),
            **counts,
        }

    def _models(self, work: StageWork, mapping: KaptureFolder, data: KaptureData) -> list[Model]:
        local_type, structure = self.options.main_type(), self._structure
        keypoints, images = mapping.keypoints(local_type), data.image_names()
        photographs = []
        for image in images:
            sensor, px = data.record_of(image)[1], keypoints.read(image)[:, :2]
            is_doubtful = data.sensors[sensor].name == ""
            photographs.append(Photograph(image, sensor, data.camera_of(image), px, is_doubtful))
        counts = read_match_counts(work.path(paths.PHOTOGRAPH_MATCHES), local_type)
        putative = {pair: count.matches for pair, count in counts.items()}
        reader = mapping.matches(local_type)
        matches = matches_of(reader, images, matched_pairs(reader, images, putative.keys()))
        for (i, j), rows in list(matches.items()):
            first, second = photographs[i], photographs[j]
            if agree_by_chance(
                first.keypoints_px[rows[:, 0]],
                first.camera,
                second.keypoints_px[rows[:, 1]],
                second.camera,
                putative[first.name, second.name],
                self.options.query_verification,
            ):
                del matches[i, j]
        try:
            return reconstruct(
                photographs,
                matches,
                structure.mapper,
                known_cameras=structure.known_cameras,
                seed=structure.seed,
                scratch=work.out,
            )
        except DataError as error:
            raise DataError(f"no map can be made: {error.message}", path=error.path) from error


def write_posed(output: Path, data: KaptureData, model: Model) -> None:
    """Write sensors, records and poses of a model's images."""
    records, sensors = {}, {}
    for (timestamp, device), name in data.records_camera.items():
        if name in model.poses:
            sensor = model.sensors[name]
            # a camera that is not among the sensors becomes a new one
            own_sensor = (
                sensor if sensor in data.sensors else f"{device}_{data.record_of(sensor)[0]}"
            )
            records[timestamp, own_sensor] = name
            sensors[own_sensor] = Sensor.from_camera(
                model.cameras[sensor], name=data.sensors[device].name
            )
    poses = {key: model.poses[name] for key, name in records.items()}
    write_sensors(
        output, replace(data, sensors=sensors, records_camera=records, trajectories=poses)
    )


def _scaled(model: Model, structure: StructureOptions) -> tuple[World, Model, dict[str, float]]:
    """Return the world, the model (in metres if the scale is known), and counts for the log."""
    if structure.distance is not None:
        first, second, metres = structure.distance
        for name in (first, second):
            require(name in model.poses, f"--scale: the map has no photograph {name!r}")
        first_center, second_center = (model.poses[name].center() for name in (first, second))
        apart = float(np.linalg.norm(first_center - second_center))
        require(apart != 0, f"--scale: {first} and {second} were taken at the same place")
        scale = metres / apart
        return World(unit=METRES), _moved(model, scale), {"metres_per_unit": scale}
    if structure.gps is None:
        return World(unit=NO_METRES), model, {}
    centers = {name: pose.center() for name, pose in model.poses.items()}
    alignment = align_to_earth(centers, structure.gps)
    counts = {
        "positions_from_GPS": alignment.num_positions,
        "GPS_residual_m": round(alignment.residual_m, 3),
        "metres_per_unit": alignment.scale,
    }
    world = World(unit=METRES, geo_origin=alignment.origin)
    return world, _moved(model, alignment.scale, alignment.enu_from_map), counts


def _moved(model: Model, scale: float, turned: RigidTransform = _UNTURNED) -> Model:
    """Return the model with world coordinates transformed by ``x -> turned(scale * x)``."""
    back = turned.inverse()
    poses = {name: pose.scaled(scale) @ back for name, pose in model.poses.items()}
    return replace(model, poses=poses)

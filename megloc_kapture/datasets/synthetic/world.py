"""The synthetic world: its places, the mapping rig's stops, the queries; nothing is drawn yet.

:func:`build_world` decides everything from the options; :mod:`views` draws one shot at a time,
and writers turn shots into files of whatever layout.
"""

from __future__ import annotations

from dataclasses import dataclass

from megloc_kapture.datasets.synthetic.cameras import rig_cameras, rig_geometry
from megloc_kapture.datasets.synthetic.covisibility import CoarseView, coarse_view
from megloc_kapture.datasets.synthetic.mapping_shots import mapping_stops, rig_sensor_id
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions
from megloc_kapture.datasets.synthetic.places import Place, build_place
from megloc_kapture.datasets.synthetic.query_shots import query_shots
from megloc_kapture.datasets.synthetic.shots import Shot
from megloc_kapture.values import Camera, RigidTransform


@dataclass(frozen=True, eq=False)
class SyntheticWorld:
    """Everything there is, in one world frame (metres, z up).

    Parameters
    ----------
    options : that the world was built from.
    places : by index.
    rig_cameras : the mapping rig's cameras by sensor id.
    sensor_from_rig : their places on the rig.
    rig_from_world : the rig's poses by timestamp.
    mapping, queries : all images, sorted by name.
    """

    options: SyntheticWorldOptions
    places: tuple[Place, ...]
    rig_cameras: dict[str, Camera]
    sensor_from_rig: dict[str, RigidTransform]
    rig_from_world: dict[int, RigidTransform]
    mapping: tuple[Shot, ...]
    queries: tuple[Shot, ...]

    def shots(self) -> tuple[Shot, ...]:
        """All images, those of the map first."""
        return self.mapping + self.queries

    def coarse_views(self) -> dict[str, CoarseView]:
        """What every shot sees, coarsely and without moving objects, by image name; world frame.

        With :func:`covisibility.overlap` this tells which map images a query really shares
        anything with.
        """
        surfaces = [place.surfaces_in_world() for place in self.places]
        return {
            shot.name: coarse_view(surfaces[shot.place], shot.camera, shot.cam_from_world)
            for shot in self.shots()
        }


def build_world(options: SyntheticWorldOptions | None = None) -> SyntheticWorld:
    """Lay out the world and choose all its shots; the same options give the same world."""
    options = options or SyntheticWorldOptions()
    places = tuple(build_place(options, index) for index in range(options.num_places))
    rig_from_world: dict[int, RigidTransform] = {}
    mapping: list[Shot] = []
    queries: list[Shot] = []
    for place in places:
        seen: list[Shot] = []
        for stop in mapping_stops(options, place):
            rig_from_world[stop.timestamp] = stop.rig_from_world
            seen += stop.shots
        queries += query_shots(options, place, seen, "day", options.day_queries)
        queries += query_shots(options, place, seen, "night", options.night_queries)
        mapping += seen
    return SyntheticWorld(
        options=options,
        places=places,
        rig_cameras={rig_sensor_id(k): camera for k, camera in rig_cameras(options).items()},
        sensor_from_rig={rig_sensor_id(k): pose for k, pose in rig_geometry().items()},
        rig_from_world=rig_from_world,
        mapping=tuple(sorted(mapping, key=lambda shot: shot.name)),
        queries=tuple(sorted(queries, key=lambda shot: shot.name)),
    )

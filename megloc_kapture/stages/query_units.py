"""Which query images are localized together: each by itself, or the cameras of a rig."""

from __future__ import annotations

from dataclasses import dataclass

from megloc_kapture.io.kapture import KaptureData
from megloc_kapture.values import RigidTransform


@dataclass(frozen=True)
class QueryUnit:
    """Images that get one pose: one image, or those a rig took at one moment.

    Attributes
    ----------
    images : sorted by name.
    cams_from_rig : of each image; for one image the identity.
    """

    images: tuple[str, ...]
    cams_from_rig: tuple[RigidTransform, ...]

    def alone(self) -> list[QueryUnit]:
        """Each image by itself."""
        return [QueryUnit((image,), (RigidTransform.identity(),)) for image in self.images]


def query_units(data: KaptureData, *, rigs: bool) -> list[QueryUnit]:
    """The units of a query folder, sorted by their first images; every image is in one.

    Parameters
    ----------
    rigs : whether cameras of one rig and one timestamp are localized together. A camera on several
        rigs goes with the first by name.
    """
    if not rigs:
        single = QueryUnit(tuple(data.image_names()), ())
        return single.alone()
    rig_of: dict[str, str] = {}
    for rig, members in sorted(data.rigs.items()):
        for sensor in members:
            rig_of.setdefault(sensor, rig)
    together: dict[tuple[int, str, str], list[str]] = {}
    for image in data.image_names():
        timestamp, sensor = data.record_of(image)
        owner = ("rig", rig_of[sensor]) if sensor in rig_of else ("sensor", sensor)
        together.setdefault((timestamp, *owner), []).append(image)
    units = []
    for (_, kind, name), images in together.items():
        if kind == "sensor" or len(images) == 1:
            units += QueryUnit(tuple(images), ()).alone()
            continue
        sensors = [data.record_of(image)[1] for image in images]
        units.append(QueryUnit(tuple(images), tuple(data.rigs[name][s] for s in sensors)))
    return sorted(units, key=lambda unit: unit.images)

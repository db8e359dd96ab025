"""Images of one moment on one rig are one unit; all others are by themselves."""

from __future__ import annotations

from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.stages.query_units import query_units
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Sensor.from_camera(Camera("SIMPLE_PINHOLE", 64, 48, (50.0, 32.0, 24.0)))
LEFT = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.3, 0.0, 0.0))
REAR = RigidTransform((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def data() -> KaptureData:
    records = {
        (1, "left"): "left/1.png",
        (1, "rear"): "rear/1.png",
        (1, "phone"): "a/1.png",
        (2, "left"): "left/2.png",
        (3, "rear"): "rear/3.png",
        (3, "left"): "left/3.png",
    }
    return KaptureData(
        sensors={"left": CAMERA, "rear": CAMERA, "phone": CAMERA},
        rigs={"car": {"left": LEFT, "rear": REAR}},
        records_camera=records,
    )


def test_each_image_by_itself() -> None:
    units = query_units(data(), rigs=False)
    assert [unit.images for unit in units] == [(name,) for name in data().image_names()]
    assert all(unit.cams_from_rig == (RigidTransform.identity(),) for unit in units)


def test_cameras_of_a_moment_are_together() -> None:
    units = query_units(data(), rigs=True)
    assert [unit.images for unit in units] == [
        ("a/1.png",),
        ("left/1.png", "rear/1.png"),
        ("left/2.png",),
        ("left/3.png", "rear/3.png"),
    ]
    assert units[1].cams_from_rig == (LEFT, REAR)
    # the other camera of the moment is missing: a camera by itself needs no rig
    assert units[2].cams_from_rig == (RigidTransform.identity(),)
    assert sorted(name for unit in units for name in unit.images) == data().image_names()

"""A small RobotCar Seasons in its official layout, written by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from aachen_files import put

from megloc_kapture.io.images import write_image

BASE = 1_418_721_355_000_000
CAMERAS = ("left", "rear", "right")


def ts(number: int) -> int:
    return BASE + number


# location of each time, and the lists of version 2
REFERENCE = {1: "001", 2: "001", 3: "002"}
QUERIES = {11: ("dawn", "001"), 12: ("dawn", "002"), 13: ("night", "001"), 14: ("rain", "002")}
TRAIN, TEST, NEITHER = (11, 13), (12,), 14


def camera_row(number: int, camera: str) -> str:
    """NVM: camera ``camera`` of reference moment ``number``; its centre is (number, camera, 0)."""
    # turned by 180 degrees about z, so that centre and translation differ in more than sign
    name = f"./overcast-reference/{camera}/{ts(number)}.png"
    return f"{name} 400 0 0 0 1 {number} {CAMERAS.index(camera)} 0.25 0 0"


def write_layout(root: Path) -> None:
    for camera in CAMERAS:
        put(root / f"intrinsics/{camera}_intrinsics.txt", "cy 3.5\ncx 4.25\nfy 10\nfx 10.5\n")
        across = {"left": -1, "rear": 0, "right": 1}[camera]
        # looks back: z of the camera is -z of the car
        put(
            root / f"extrinsics/{camera}_extrinsics.txt",
            f"-1,0,0,{across}\n0,1,0,0.5\n0,0,-1,2\n0,0,0,1\n",
        )
    rows = [camera_row(number, camera) for number in REFERENCE for camera in CAMERAS]
    nvm = root / "3D-models/all-merged/all.nvm"
    put(nvm, "NVM_V3 \n\n" + f"{len(rows)}\n" + "\n".join(rows) + "\n\n0\n")
    individual = root / "3D-models/individual"
    for location in ("001", "002"):
        folder = individual / f"colmap_reconstructions/{location}_aligned"
        put(folder / "cameras.txt", "".join(f"{k} SIMPLE_RADIAL 8 6 10 4 3 0\n" for k in (1, 2, 3)))
        images = ""
        for number, place in REFERENCE.items():
            for k, camera in enumerate(CAMERAS):
                if place == location:
                    # t = -R C with R = diag(-1, -1, 1)
                    name = f"overcast-reference/{camera}/{ts(number)}.png"
                    images += f"{10 * number + k} 0 0 0 1 {number} {k} -0.25 {k + 1} {name}\n\n"
        put(folder / "images.txt", images)
        put(folder / "points3D.txt", "")
        names = [
            f"{condition}/{camera}/{ts(number)}.jpg"
            for number, (condition, place) in QUERIES.items()
            for camera in CAMERAS
            if place == location
        ]
        put(individual / f"queries_per_location/queries_location_{location}.txt", "\n".join(names))
    put(
        root / "robotcar_v2_train.txt",
        "".join(
            f"{QUERIES[n][0]}/rear/{ts(n)}.png 0 -1 0 {n} 1 0 0 5 0 0 1 -2 0 0 0 1\n" for n in TRAIN
        ),
    )
    put(root / "robotcar_v2_test.txt", "".join(f"rear/{ts(n)}.png\n" for n in TEST))
    image = np.full((6, 8, 3), 77, np.uint8)
    for number in REFERENCE:
        for camera in CAMERAS:
            write_image(root / f"images/overcast-reference/{camera}/{ts(number)}.jpg", image)
    for number, (condition, _) in QUERIES.items():
        for camera in CAMERAS:
            write_image(root / f"images/{condition}/{camera}/{ts(number)}.jpg", image)

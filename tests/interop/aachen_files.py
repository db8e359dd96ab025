"""A small Aachen Day-Night in its official layout, written by hand: v1.0, and v1.1 in its tree."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from megloc_kapture.io.images import write_image

DATABASE = ("db/7.jpg", "db/1228.jpg", "db/3.jpg")
SIZES = {"db/7.jpg": (8, 6), "db/1228.jpg": (6, 8), "db/3.jpg": (8, 6)}
SEQUENCE = ("sequences/nexus4_sequences/sequence_1/a.jpg", "sequences/gopro3_undistorted/b.png")
DAY = tuple(f"query/day/{name}.jpg" for name in ("nexus4/IMG_2", "milestone/m_1", "nexus4/IMG_1"))
NIGHT = ("query/night/nexus5x/IMG_9.jpg",)
ADDED = ("query/night/nexus5x_additional_night/IMG_8.jpg",)
UNLISTED = "query/day/nexus4/IMG_3.jpg"

MODEL, LIST = "3D-models/aachen_cvpr2018_db.nvm", "3D-models/database_intrinsics.txt"
DAY_LIST = "queries/day_time_queries_with_intrinsics.txt"
NIGHT_LIST = "queries/night_time_queries_with_intrinsics.txt"

# poses with different centre and translation, and distortions of both signs
NVM = """NVM_V3\x20

3
db/7.jpg 10.5 1 0 0 0 2.0 0.0 -5.0 0.08 0
db/1228.jpg 11 0 0 0 1 1.0 2.0 3.0 -0.5 0
db/3.jpg 12 0.5 0.5 0.5 0.5 700.0 -8.0 -40.0 0.25 0

2
2 0 5 255 0 9 2 0 4 4.5 3.25 2 1 1 2
1 1 1 1 2 3 2 2 7 5 5 1 0 3 3
"""
INTRINSICS = """db/3.jpg SIMPLE_RADIAL 8 6 12 4.25 3 -0.25
db/7.jpg SIMPLE_RADIAL 8 6 10.5 4 3 -0.08
db/1228.jpg SIMPLE_RADIAL 6 8 11 3 4 0.5"""
CAMERAS = """# Camera list
9 SIMPLE_RADIAL 8 6 12 4.25 3 -0.25
2 SIMPLE_RADIAL 6 8 11 3 4 0.5
5 PINHOLE 8 6 9.123456789012345 9 4 3
"""
# the identity's second line is empty; 9 and 5 are shared, ids have no order
IMAGES = f"""# Image list
4 1 0 0 0 -2 0 5 9 db/7.jpg

30 0 0 0 1 1 2 -3 2 db/1228.jpg
1 2 -1
2 0.5 0.5 0.5 0.5 40 -700 8 9 db/3.jpg

11 1 0 0 0 0 0 1 5 {SEQUENCE[0]}

10 0.5 -0.5 0.5 0.5 -652.833568325199 84.70595670766824 5.1 5 {SEQUENCE[1]}

"""


def put(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def picture(path: Path, size: tuple[int, int] = (8, 6)) -> None:
    write_image(path, np.full((size[1], size[0], 3), 99, np.uint8))


def query_list(names: tuple[str, ...]) -> str:
    # the published lists end without a line end
    return "\n".join(f"{name} SIMPLE_RADIAL 8 6 7.5 4 3 -0.0353019" for name in names)


def write_v1_0(root: Path) -> Path:
    put(root / MODEL, NVM)
    put(root / LIST, INTRINSICS)
    put(root / DAY_LIST, query_list(DAY))
    put(root / NIGHT_LIST, query_list(NIGHT))
    # files that the adapter must ignore
    put(root / "queries/day_time_queries_without_intrinsics.txt", "\n".join(DAY))
    put(root / "3D-models/aachen_cvpr2018_db.list.txt", "\n".join(DATABASE))
    for name in (*DATABASE, *DAY, *NIGHT, UNLISTED):
        picture(root / "images_upright" / name, SIZES.get(name, (8, 6)))
    return root


def write_v1_1(root: Path) -> Path:
    for name in (*SEQUENCE, *ADDED):
        picture(root / "images_upright" / name)
    put(root / NIGHT_LIST, query_list(ADDED + NIGHT))
    for name, content in (("cameras", CAMERAS), ("images", IMAGES), ("points3D", "")):
        put(root / f"3D-models/aachen_v_1_1/{name}.txt", content)
    return root

"""A small InLoc in its official layout, written by hand: a scan on each of two floors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.io
from PIL import Image

WIDTH, HEIGHT = 40, 30
FLOORS = ("DUC1", "DUC2")
# before and after the refinement by ICP
TRANSFORMATION = """Before general icp:
1 0 0 9
0 1 0 9
0 0 1 9
0 0 0 1

After general icp:
0 -1 0 5
1 0 0 2
0 0 1 0
0 0 0 1
"""
VIEWS = [(yaw, pitch) for yaw in range(0, 360, 30) for pitch in (-30, 0, 30)]


def write_download(root: Path) -> Path:
    grey = Image.fromarray(np.full((HEIGHT, WIDTH), 128, np.uint8))
    points = np.random.default_rng(0).uniform(-3, 3, (HEIGHT, WIDTH, 3))
    points[17, 5] = np.nan
    for floor in FLOORS:
        folder = root / "database" / "cutouts" / floor / "024"
        folder.mkdir(parents=True)
        for yaw, pitch in VIEWS:
            image = folder / f"DUC_cutout_024_{yaw}_{pitch}.jpg"
            grey.save(image)
            content = {"XYZcut": points, "RGBcut": np.zeros((2, 2, 3), np.uint8)}
            scipy.io.savemat(
                image.with_name(f"{image.name}.mat"),
                content,
                do_compression=pitch == 0,
                appendmat=False,
            )
        place = root / "database" / "alignments" / floor / "transformations"
        place.mkdir(parents=True)
        (place / "DUC_trans_024.txt").write_text(TRANSFORMATION)
    queries = root / "query" / "iphone7"
    queries.mkdir(parents=True)
    for name, size in (("IMG_0801.JPG", (64, 48)), ("IMG_0803.JPG", (48, 64))):
        Image.new("RGB", size).save(queries / name, format="JPEG")
    exif = Image.Exif()
    exif[0x0112] = 6  # "to be turned by 90 degrees"
    Image.new("RGB", (64, 48)).save(queries / "IMG_0802.jpg", exif=exif)
    (queries / "._IMG_0801.JPG").write_bytes(b"an archiver's leavings")
    (queries / "readme.txt").write_text("no image")
    return root

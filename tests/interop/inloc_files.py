"""A small InLoc in its official layout, written by hand: a scanner in a box, on two floors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.io
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]

WIDTH, HEIGHT = 40, 30
CENTRES = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)
BOX_LOW, BOX_HIGH = np.array([-3.0, -2.0, -1.5]), np.array([4.0, 2.5, 1.3])
# floor_from_scan: the axes of the scans in their floors, and where they stand
SCANS = {
    "DUC1": (Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.array([5.0, 2.0, 0.0])),
    "DUC2": (
        Rotation.from_euler("zx", [-37, 1], degrees=True).as_matrix(),
        np.array([5.0, 2.5, 1]),
    ),
}
VIEWS = [(yaw, pitch) for yaw in range(0, 360, 30) for pitch in (-30, 0, 30)]


def scanned(yaw_deg: int, pitch_deg: int) -> Floats:
    """Return the points (H, W, 3) of a cutout's pixels in the scanner's frame."""
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    forward = np.array([-np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    focal = WIDTH / 2 / np.tan(np.pi / 6)
    x, y = np.moveaxis((CENTRES - (WIDTH / 2, HEIGHT / 2)) / focal, -1, 0)
    rays = forward + x[..., None] * right + y[..., None] * down
    reach = np.where(rays > 0, BOX_HIGH, BOX_LOW) / rays
    points = rays * reach.min(axis=-1, keepdims=True)
    points[0, 0] = points[17, 5] = np.nan
    return points


def transformation(rotation: Floats, translation: Floats) -> str:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    rows = [" ".join(f"{value:.12g}" for value in row) for row in matrix]
    before = ["1 0 0 9", "0 1 0 9", "0 0 1 9", "0 0 0 1"]
    return "\n".join(["Before general icp:", *before, "", "After general icp:", *rows])


def write_download(root: Path) -> Path:
    grey = Image.fromarray(np.full((HEIGHT, WIDTH), 128, np.uint8))
    for floor, (rotation, translation) in SCANS.items():
        folder = root / "database" / "cutouts" / floor / "024"
        folder.mkdir(parents=True)
        for yaw, pitch in VIEWS:
            image = folder / f"DUC_cutout_024_{yaw}_{pitch}.jpg"
            grey.save(image)
            content = {"XYZcut": scanned(yaw, pitch), "RGBcut": np.zeros((2, 2, 3), np.uint8)}
            scipy.io.savemat(
                image.with_name(f"{image.name}.mat"),
                content,
                do_compression=pitch == 0,
                appendmat=False,
            )
        place = root / "database" / "alignments" / floor / "transformations"
        place.mkdir(parents=True)
        (place / "DUC_trans_024.txt").write_text(transformation(rotation, translation))
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

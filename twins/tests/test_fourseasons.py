"""4Seasons' twin: its import is its truth, checked by kapture's objects and COLMAP's cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from megloc_twins.fourseasons import DUSK, REFERENCE, WINTER

from megloc_kapture.datasets.fourseasons import read_gnss_poses
from megloc_kapture.geometry.poses import earth_from_enu, geodetic
from megloc_kapture.io.images import read_image_rgb

LAYOUT = "4seasons"


def times_of(folder: Path) -> list[int]:
    return [int(line.split()[0]) for line in (folder / "times.txt").read_text().splitlines()]


def test_the_layouts_quirks(root: Path) -> None:
    for name in (REFERENCE, WINTER, DUSK):
        folder = root / name
        times = times_of(folder)
        assert times == sorted(times)
        on_disk = {int(p.stem) for p in (folder / "undistorted_images/cam0").iterdir()}
        assert on_disk < set(times)  # frames without images
        if name == DUSK:
            assert sorted(p.name for p in folder.iterdir()) == ["times.txt", "undistorted_images"]
            continue
        keyframes = set(read_gnss_poses(folder / "GNSSPoses.txt"))
        assert keyframes < on_disk  # and images that are of no keyframe
        header, row, *_ = (folder / "GNSSPoses.txt").read_text().splitlines()
        assert (header.count(","), row.count(",")) == (10, 9)
        blank = "\n\n" in (folder / "Transformations.txt").read_text()
        assert blank == (name == REFERENCE)
    image = read_image_rgb(next((root / REFERENCE / "undistorted_images/cam0").iterdir()))
    assert image.shape == (100, 200, 3)
    assert (image == image[..., :1]).all()  # grey


@pytest.mark.parametrize("place", [(-33.9, 151.2, 12.0), (0.0, -180.0, -30.0)])
def test_geodesy(place: tuple[float, float, float]) -> None:
    result = geodetic(np.array(earth_from_enu(*place).translation))
    np.testing.assert_allclose(np.abs(result), np.abs(place), atol=1e-8)
    # WGS 84 at the equator and the pole
    equator, pole = (earth_from_enu(latitude, 0, 0).translation for latitude in (0, 90))
    np.testing.assert_allclose(equator, (6378137, 0, 0), rtol=0, atol=1e-6)
    np.testing.assert_allclose(pole[2], 6356752.314245, rtol=0, atol=1e-5)
    enu = earth_from_enu(*place).rotation_matrix()
    np.testing.assert_allclose(enu.T @ enu, np.eye(3), atol=1e-12)
    higher = earth_from_enu(place[0], place[1], place[2] + 1).translation
    step = np.array(higher) - earth_from_enu(*place).translation
    np.testing.assert_allclose(enu[:, 2], step, atol=1e-8)

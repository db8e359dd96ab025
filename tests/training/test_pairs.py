"""Pairs of a rendered kapture and of photographs, and random views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from corner import depth_m, pose_at, render, write_kapture
from images import texture
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from megloc_kapture.errors import DataError
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureFolder, read_pairs, write_pairs
from megloc_kapture.training import pairs as training_pairs
from megloc_kapture.training.pairs import Photographs, PosedPairs, random_view

# as conftest.py has them
POSES = {f"{k}.png": pose_at((-2.4 + 0.8 * k, 0, 0), 24.0 - 12.0 * k, 0) for k in range(5)}
SMALL = 200  # longer side, px


def test_pairs_are_drawn_from_overlap_bins(walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = PosedPairs(KaptureFolder(walk), SMALL)
    assert source.counts()["images"] == 5 and source.counts()["pairs"] > 4
    baselines = {}
    for low, high in ((0.3, 0.5), (0.5, 0.7)):
        monkeypatch.setattr(training_pairs, "_OVERLAP_BINS", (low, high))
        narrow = PosedPairs(KaptureFolder(walk), SMALL)
        moved = []
        for seed in range(8):
            b_from_a = narrow.draw(np.random.default_rng(seed)).b_from_a
            assert b_from_a is not None
            moved.append(np.linalg.norm(b_from_a.center()))
        baselines[low] = np.mean(moved)
    assert baselines[0.3] > baselines[0.5] + 0.4


def test_measured_overlaps_are_read_again(walk: Path, tmp_path: Path) -> None:
    path = tmp_path / "overlaps" / "0.txt"
    source = PosedPairs(KaptureFolder(walk), SMALL, measured=path)
    pairs = read_pairs(path)
    assert len(pairs) == 10 and 0.5 < max(pair.score for pair in pairs) < 1
    # the file's overlaps are used: all but one pair overlap too much
    write_pairs(path, [replace(p, score=0.99) for p in pairs[1:]] + [replace(pairs[0], score=0.2)])
    again = PosedPairs(KaptureFolder(walk), SMALL, measured=path)
    assert again.counts()["pairs"] == 1 < source.counts()["pairs"]


def test_pairs_have_reduced_images_and_geometry(walk: Path) -> None:
    source = PosedPairs(KaptureFolder(walk), SMALL)
    pair, again = (source.draw(np.random.default_rng(3)) for _ in range(2))
    assert pair.keys == again.keys and pair.keys is not None and pair.views is not None
    names = [Path(key).name for key in pair.keys]
    assert names[0] != names[1]
    for name, image, view in zip(names, pair.images, pair.views, strict=True):
        assert image.shape == (150, 200, 3)
        assert (view.camera.width, view.camera.height) == (200, 150)
        assert view.camera.params[0] == pytest.approx(150.0)
        whole = render(POSES[name]).astype(np.float64)
        halved = whole.reshape(150, 2, 200, 2, 3).mean(axis=(1, 3))
        assert np.abs(image - halved).max() <= 1
        np.testing.assert_array_equal(view.depth.depth_m, depth_m(POSES[name]))
    # a point of the wall is where both cameras see it
    a, b = (POSES[name] for name in names)
    point = np.array([[-1.5, 0.3, 6.0]])
    px = []
    for pose in (a, b):
        x, y, z = pose.apply(point)[0]
        px.append(np.array([[150 * x / z + 100, 151 * y / z + 75]]))
    assert pair.label(px[0], px[1]).partner_a.tolist() == [0]
    assert pair.label(px[0], px[1] + 10).partner_a.tolist() == [-1]
    assert {tuple(source.draw(np.random.default_rng(k)).keys or ()) for k in range(30)} >= {
        pair.keys,
        (pair.keys[1], pair.keys[0]),
    }


def test_invalid_training_data_is_refused(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_kapture(tmp_path / "flat", POSES, with_poses=True)
    with pytest.raises(DataError, match=r"flat: no two images have a pose and a depth map"):
        PosedPairs(KaptureFolder(tmp_path / "flat"), SMALL)
    monkeypatch.setattr(training_pairs, "_OVERLAP_BINS", (0.98, 0.99))
    with pytest.raises(
        DataError, match=r"no pair of images overlaps by 0\.98 to 0\.99; the 10 candidate pairs"
    ):
        PosedPairs(KaptureFolder(walk), SMALL)
    with pytest.raises(DataError, match="no such folder"):
        Photographs(tmp_path / "nowhere", SMALL)
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="no image"):
        Photographs(tmp_path / "empty", SMALL)


def test_views_of_one_photograph(tmp_path: Path) -> None:
    write_image(tmp_path / "sub" / "photo.jpg", render(POSES["2.png"]))
    (tmp_path / "notes.txt").write_text("no image")
    source = Photographs(tmp_path, SMALL)
    assert source.counts() == {"images": 1}
    pair, again = (source.draw(np.random.default_rng(0)) for _ in range(2))
    assert pair.images[0].shape == (150, 200, 3) and pair.keys is None and pair.views is None
    assert pair.images[0].tobytes() == again.images[0].tobytes() != pair.images[1].tobytes()
    grid = np.stack(np.meshgrid(np.arange(0.5, 200, 4), np.arange(0.5, 150, 4)), -1).reshape(-1, 2)
    matches = pair.label(grid, grid).matches()
    assert len(matches) > 50
    # partners of a grid under a homography are near one, fitted to them
    a, b = (grid[rows] for rows in matches.T)
    px_in_b = cv2.perspectiveTransform(a[None], cv2.findHomography(a, b)[0])[0]
    assert np.linalg.norm(px_in_b - b, axis=1).mean() < 3


def bilinear(image: NDArray[np.uint8], px: NDArray[np.float64]) -> NDArray[np.float64]:
    at = (px - 0.5).T[::-1]
    channels = np.moveaxis(image.astype(np.float64), 2, 0)
    return np.stack([map_coordinates(channel, at, order=1) for channel in channels], axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_a_view_follows_its_homography(seed: int) -> None:
    image = texture(240, 320, sigma_px=6.0)
    rng = np.random.default_rng(seed)
    view, view_from_image = random_view(image, (160, 120), rng)
    assert view.shape == (120, 160, 3)
    px = rng.uniform((2, 2), (158, 118), (200, 2))
    px_in_image = cv2.perspectiveTransform(px[None], np.linalg.inv(view_from_image))[0]
    # all of it lies in the photograph
    assert (px_in_image > -1e-3).all() and (px_in_image < (320.001, 240.001)).all()
    inside = ((px_in_image > 1) & (px_in_image < (318, 238))).all(axis=1)
    error = bilinear(view, px[inside]) - bilinear(image, px_in_image[inside])
    assert np.abs(error).mean() < 1.0

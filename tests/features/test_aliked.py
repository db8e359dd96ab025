"""ALIKED keypoints: kornia's, hand-made score maps, and the geometry of real scenes."""

from __future__ import annotations

import pickle
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.features import aliked
from megloc_kapture.features.aliked import Aliked, AlikedOptions
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.matching.nearest_neighbours import match_nearest
from megloc_kapture.matching.verification import ray_slopes, sampson_error_px
from megloc_kapture.values import LocalFeatures

Image = NDArray[np.uint8]


@pytest.fixture(autouse=True)
def weights(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(shared_data / "weights"))


def extractor(**options: object) -> Aliked:
    return Aliked(AlikedOptions.model_validate({"device": "cpu", **options}))


@pytest.fixture(scope="module")
def photograph(shared_data: Path) -> Image:
    folder = KaptureFolder(shared_data / "scenes" / "fountain_p11" / "mapping")
    name = sorted(folder.read().poses())[0]
    return np.ascontiguousarray(read_image_rgb(folder.image_path(name))[300:540, 400:720])


def squares(centres: NDArray[np.int64], side: int, size: tuple[int, int] = (240, 320)) -> Image:
    """Bright squares of an odd side around pixels (x, y)."""
    gray = np.full(size, 60, np.uint8)
    half = side // 2
    for x, y in centres:
        gray[y - half : y + half + 1, x - half : x + half + 1] = 200
    return np.repeat(gray[..., None], 3, axis=2)


def assert_same(a: LocalFeatures, b: LocalFeatures) -> None:
    np.testing.assert_array_equal(a.keypoints_px, b.keypoints_px)
    np.testing.assert_array_equal(a.scores, b.scores)
    np.testing.assert_array_equal(a.descriptors, b.descriptors)


@pytest.mark.parametrize("variant", ["aliked-t16", "aliked-n16", "aliked-n16rot", "aliked-n32"])
def test_keypoints_are_kornias(photograph: Image, shared_data: Path, variant: str) -> None:
    feature = pytest.importorskip("kornia.feature")
    net = feature.ALIKED(variant, max_num_keypoints=20_000)
    file = shared_data / "weights" / "aliked" / f"{variant}.pth"
    net.load_state_dict(torch.load(file, weights_only=True, map_location="cpu"), strict=False)
    image = photograph[:195, :262]  # no multiples of 32
    planes = torch.from_numpy(image.transpose(2, 0, 1).astype(np.float32) / 255)
    with torch.inference_mode():
        theirs = net.eval()(planes[None])[0]
    ours = extractor(weights=variant, max_keypoints=20_000).extract(image)
    assert theirs.n > 80
    expected = theirs.keypoints.numpy() + 0.5  # kornia's pixel centres are integers
    distance = np.linalg.norm(expected[:, None] - ours.keypoints_px[None, :, :2], axis=2)
    row = distance.argmin(axis=1)
    assert len(set(row.tolist())) == theirs.n
    assert distance.min(axis=1).max() < 1e-3
    np.testing.assert_allclose(ours.scores[row], theirs.keypoint_scores.numpy(), atol=1e-4)
    np.testing.assert_allclose(ours.descriptors[row], theirs.descriptors.numpy(), atol=1e-4)
    # kornia keeps the strict maxima only; the authors' suppression, and ours, adds to them what
    # these do not suppress
    assert theirs.n <= len(ours.scores) <= 1.2 * theirs.n


def test_a_peak_of_the_score_map_lies_at_its_pixels_centre(monkeypatch: pytest.MonkeyPatch) -> None:
    scores = torch.full((40, 50), 0.01)
    for x, y, score in ((20, 10, 0.9), (35, 30, 0.6), (1, 20, 0.8), (30, 5, 0.15)):
        scores[y - 1 : y + 2, x - 1 : x + 2] = score / 2
        scores[y, x] = score
    maps = SimpleNamespace(scores=scores)

    class Net:
        def __call__(self, image: torch.Tensor) -> list[SimpleNamespace]:
            return [maps]

        def desc_head(self, _: object, xy: torch.Tensor) -> torch.Tensor:
            return torch.ones(len(xy), 128)

    monkeypatch.setattr(aliked.Aliked, "network", lambda *_: (Net(), torch.device("cpu")))
    found = extractor().extract(np.zeros((40, 50, 3), np.uint8))
    # the one at x = 1 is within two pixels of the border, the last one is too weak
    np.testing.assert_allclose(
        found.keypoints_px, [[20.5, 10.5, 0.9], [35.5, 30.5, 0.6]], atol=1e-5
    )


@pytest.mark.parametrize("side", [9, 11])
def test_corners_of_squares_are_found_on_their_pixels(side: int) -> None:
    x, y = np.meshgrid(np.arange(40, 300, 37), np.arange(40, 210, 33))
    centres = np.stack([x.ravel(), y.ravel()], axis=1)
    found = extractor().extract(squares(centres, side)).keypoints_px[:, :2]
    # this network answers to the lower right corner; its pixel's centre has a half in it
    corners = centres + side // 2 + 0.5
    offset = found[np.linalg.norm(found[:, None] - corners, axis=2).argmin(axis=0)] - corners
    assert np.abs(np.median(offset, axis=0)).max() < 0.15
    assert np.abs(offset).max() < 1


def test_a_shifted_image_has_shifted_keypoints(shared_data: Path) -> None:
    folder = KaptureFolder(shared_data / "scenes" / "fountain_p11" / "mapping")
    whole = read_image_rgb(folder.image_path(sorted(folder.read().poses())[0]))
    dx, dy = 8, 16
    first = extractor().extract(np.ascontiguousarray(whole[300:652, 400:880])).keypoints_px[:, :2]
    moved = np.ascontiguousarray(whole[300 - dy : 652 - dy, 400 - dx : 880 - dx])
    second = extractor().extract(moved).keypoints_px[:, :2]
    inside = ((first > 64) & (first < [480 - 64, 352 - 64])).all(axis=1)
    expected = first[inside] + (dx, dy)
    apart = np.linalg.norm(expected[:, None] - second, axis=2)
    nearest = apart.min(axis=1)
    difference = (second[apart.argmin(axis=1)] - expected)[nearest < 1]
    assert inside.sum() > 200
    # not exactly: how the coarse levels are enlarged depends on the place in the image
    assert np.median(nearest) < 0.1
    assert (nearest < 0.5).mean() > 0.85
    assert np.abs(difference.mean(axis=0)).max() < 0.05


@pytest.mark.parametrize(
    ("scene", "step", "keypoints", "least"),
    [("fountain_p11", 1, 1500, 0.6), ("redkitchen_rgbd", 5, 500, 0.6)],
)
def test_matches_of_real_images_lie_on_epipolar_lines(
    shared_data: Path, scene: str, step: int, keypoints: int, least: float
) -> None:
    folder = KaptureFolder(shared_data / "scenes" / scene / "mapping")
    data = folder.read()
    names = sorted(data.poses())[: step + 1 : step]
    features = [extractor().extract(read_image_rgb(folder.image_path(name))) for name in names]
    # the large one has as many as the default keeps
    assert all(keypoints <= len(found.scores) <= 1500 for found in features)
    for (a, of_a), (b, of_b) in pairwise(zip(names, features, strict=True)):
        matches, _ = match_nearest(of_a.descriptors, of_b.descriptors)
        sides = []
        for name, of, rows in ((a, of_a, matches[:, 0]), (b, of_b, matches[:, 1])):
            px, camera = of.keypoints_px[rows, :2], data.camera_of(name)
            rays = bearing_rays(camera, px)
            sides += [rays, ray_slopes(camera, px, rays)]
        pose_a, pose_b = data.cam_from_world(a), data.cam_from_world(b)
        assert pose_a is not None and pose_b is not None
        error = sampson_error_px(*sides, pose_b @ pose_a.inverse())
        assert len(matches) > 200
        assert (error < 2).mean() > least


def test_scores_fall_and_the_best_are_kept(photograph: Image) -> None:
    every = extractor(max_keypoints=100_000).extract(photograph)
    some = extractor(max_keypoints=60).extract(photograph)
    assert len(every.scores) > 200 and len(some.scores) == 60
    assert (np.diff(every.scores) <= 0).all()
    np.testing.assert_array_equal(some.keypoints_px, every.keypoints_px[:60])
    np.testing.assert_array_equal(every.keypoints_px[:, 2], every.scores)
    # places are scored after they are found: a few lie just below the threshold
    assert (every.scores > 0.2).mean() > 0.9


def test_types_and_lengths(photograph: Image) -> None:
    for variant, size in (("aliked-t16", 64), ("aliked-n16", 128)):
        found = extractor(weights=variant)
        features = found.extract(photograph)
        assert found.name == variant and found.descriptor_size == size
        assert features.keypoints_px.dtype == features.scores.dtype == np.float32
        assert features.descriptors.dtype == np.dtype(found.descriptor_dtype)
        assert features.descriptors.shape == (len(features.scores), size)
        np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-5)


def test_the_mask_comes_before_the_selection(photograph: Image) -> None:
    plain = extractor(max_keypoints=100_000).extract(photograph)
    mask = np.ones(photograph.shape[:2], dtype=bool)
    mask[:, 100:] = False
    masked = extractor(max_keypoints=40).extract(photograph, mask)
    x, y = np.floor(plain.keypoints_px[:, :2]).astype(int).T
    allowed = mask[y, x]
    assert 40 < allowed.sum() < len(allowed)
    assert masked.num_masked == (~allowed).sum()
    np.testing.assert_array_equal(masked.keypoints_px, plain.keypoints_px[allowed][:40])
    assert plain.num_masked == 0


def test_a_mask_that_permits_everything_or_nothing(photograph: Image) -> None:
    everything = np.ones(photograph.shape[:2], dtype=bool)
    assert_same(extractor().extract(photograph), extractor().extract(photograph, everything))
    nothing = extractor().extract(photograph, ~everything)
    assert nothing.keypoints_px.shape == (0, 3) and nothing.descriptors.shape == (0, 128)


def test_two_runs_give_the_same_also_after_pickling(photograph: Image) -> None:
    first = extractor()
    again = pickle.loads(pickle.dumps(first))
    assert len(pickle.dumps(first)) < 2000
    assert_same(first.extract(photograph), again.extract(photograph.copy()))


def test_many_keypoints_are_described_in_parts(
    photograph: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    from megloc_kapture.nets import aliked

    whole = extractor().extract(photograph)
    monkeypatch.setitem(aliked._VALUES_AT_ONCE, "cpu", 4 * 16 * 128 * 7)
    parts = extractor().extract(photograph)
    np.testing.assert_array_equal(whole.keypoints_px, parts.keypoints_px)
    np.testing.assert_allclose(whole.descriptors, parts.descriptors, atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1, 3), (2, 5, 3), (5, 5, 3), (33, 31, 3), (120, 160, 3)])
def test_an_image_without_texture_has_no_features(shape: tuple[int, int, int]) -> None:
    features = extractor().extract(np.full(shape, 90, dtype=np.uint8))
    assert features.keypoints_px.shape == (0, 3) and features.keypoints_px.dtype == np.float32
    assert features.scores.shape == (0,) and features.descriptors.shape == (0, 128)


def test_half_precision_finds_nearly_the_same(photograph: Image) -> None:
    full = extractor().extract(photograph)
    half = extractor(half_precision=True).extract(photograph)
    assert half.keypoints_px.dtype == half.descriptors.dtype == np.float32
    # places between pixels: not rounded to what bfloat16 can hold
    assert (half.keypoints_px[:, :2] * 8 % 1 != 0).mean() > 0.9
    apart = np.linalg.norm(full.keypoints_px[:, None, :2] - half.keypoints_px[None, :, :2], axis=2)
    assert (apart.min(axis=1) < 1).mean() > 0.8


def test_weights_are_named_by_their_sha256() -> None:
    found = extractor().weights()
    assert list(found) == ["aliked-n16.pth"]
    assert len(found["aliked-n16.pth"]) == 64


def test_a_file_of_another_network_is_refused(tmp_path: Path) -> None:
    torch.save({"conv1.weight": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(DataError, match=r"other\.pth.*no ALIKED"):
        extractor(weights=str(tmp_path / "other.pth")).extract(np.zeros((40, 40, 3), np.uint8))


def test_colour_is_rgb_not_bgr(photograph: Image) -> None:
    planes = torch.from_numpy(photograph.transpose(2, 0, 1).copy())[None] / 255
    found = extractor()
    net, _ = found.network(aliked.aliked_from)
    with torch.inference_mode():
        expected, swapped = net(planes)[0].scores, net(planes.flip(1))[0].scores
    best = found.extract(photograph).keypoints_px[0]
    column, row = np.floor(best[:2]).astype(int)
    patch = np.s_[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    assert abs(float(expected[patch].max()) - best[2]) < 0.1
    assert (expected - swapped).abs().max() > 0.05

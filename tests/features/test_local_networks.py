"""ALIKED, ASLFeat, R2D2, XFeat and DISK against the networks as published."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import kornia.core.download
import numpy as np
import pytest
import torch
from convert_weights import aslfeat_state
from images import Image, texture
from kornia.feature import ALIKED, DISK
from kornia.feature.xfeat import XFeat as KorniaXFeat
from published import Tensors, plugin, random_tensors
from pydantic import ValidationError
from safetensors.torch import save_file

from megloc_kapture.features import aslfeat
from megloc_kapture.features.aliked import _VALUES_AT_ONCE, Aliked, aliked_from
from megloc_kapture.features.aslfeat import (
    AslFeat,
    on_no_edge,
    peakiness,
)
from megloc_kapture.features.kornia_features import Disk, XFeat
from megloc_kapture.features.r2d2 import R2D2, R2D2Options, pyramid_levels
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.weights import find_weights, read_weights


def test_aliked_equals_kornia(
    photograph: Image, shared_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    net = ALIKED("aliked-n16", max_num_keypoints=20_000)
    file = shared_data / "weights" / "aliked" / "aliked-n16.pth"
    net.load_state_dict(torch.load(file, weights_only=True, map_location="cpu"), strict=False)
    image = np.ascontiguousarray(photograph[300:399, 400:531])  # no multiples of 32
    planes = torch.from_numpy(image.transpose(2, 0, 1).astype(np.float32) / 255)
    with torch.inference_mode():
        theirs = net.eval()(planes[None])[0]
    monkeypatch.setitem(_VALUES_AT_ONCE, "cpu", 4 * 16 * 128 * 7)  # described in parts
    ours = plugin(Aliked, file, max_keypoints=20_000).extract(image)
    assert theirs.n > 30
    expected = theirs.keypoints.numpy() + 0.5  # kornia's pixel centres are integers
    distance = np.linalg.norm(expected[:, None] - ours.keypoints_px[None, :, :2], axis=2)
    row = distance.argmin(axis=1)
    assert len(set(row.tolist())) == theirs.n
    assert distance.min(axis=1).max() < 1e-3
    np.testing.assert_allclose(ours.scores[row], theirs.keypoint_scores.numpy(), atol=1e-4)
    np.testing.assert_allclose(ours.descriptors[row], theirs.descriptors.numpy(), atol=1e-4)
    # the authors' suppression keeps a few maxima that kornia drops
    assert theirs.n <= len(ours.scores) <= 1.2 * theirs.n


def calm_tensors(variant: str) -> Tensors:
    """Random weights that amplify rounding little."""
    tensors = random_tensors(variant)
    for key, values in tensors.items():
        if values.ndim > 1:
            values *= 0.5**0.5
        elif key.endswith(("running_var", "weight")):
            values *= 0.5
            values += 0.25
        if "offset_conv" in key:
            values *= 3  # offsets of some pixels
    return tensors


@pytest.mark.parametrize("variant", ["aliked-t16", "aliked-n32"])
def test_maps_of_aliked_equal_kornia(variant: str) -> None:
    tensors = calm_tensors(variant)
    image = torch.from_numpy(texture(43, 59)).permute(2, 0, 1)[None] / 255  # no multiples of 32
    kornia_net = ALIKED(variant)
    assert kornia_net.load_state_dict(tensors, strict=False).missing_keys == ["dkd.hw_grid"]
    with torch.inference_mode():
        features, scores = kornia_net.eval().extract_dense_map(image)
        maps = aliked_from(tensors, variant)(image)[0]
        rows, columns = torch.meshgrid(torch.arange(43), torch.arange(59), indexing="ij")
        ours = maps.features_at(rows.reshape(-1), columns.reshape(-1))
    assert scores.std() > 1e-3
    # float32 leaves 1e-4 of offsets of some pixels
    assert (maps.scores - scores[0, 0]).abs().max() < 1e-4
    assert (ours.T.reshape(-1, 43, 59) - features[0]).abs().max() < 1e-4


# written by TensorFlow, see tests/nets/data/README.md
TENSORFLOW = Path(__file__).parent.parent / "nets" / "data" / "aslfeat"


@pytest.mark.parametrize("image", ["even", "odd"])
def test_aslfeat_equals_tensorflow(image: str, tmp_path: Path) -> None:
    outputs = np.load(TENSORFLOW / "reference.npz")
    gray = outputs[f"{image}/image"]
    save_file(converted(), tmp_path / "aslfeat.safetensors")
    image_rgb = np.repeat(gray[..., None], 3, 2)
    result = plugin(AslFeat, tmp_path / "aslfeat.safetensors").extract(image_rgb)
    assert len(result.scores) > 40
    # the published network puts the first pixel's centre at (0, 0)
    np.testing.assert_allclose(
        result.keypoints_px[:, :2] - 0.5, outputs[f"{image}/keypoints"], rtol=0, atol=1e-4
    )
    np.testing.assert_allclose(result.scores, outputs[f"{image}/scores"], rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        result.descriptors, outputs[f"{image}/descriptors"], rtol=0, atol=1e-5
    )


def test_keypoints_of_all_scales_have_coordinates_of_the_image(
    monkeypatch: pytest.MonkeyPatch, random_weights: dict[str, Path]
) -> None:
    # the score is the brightness, so the spot is detected on every scale
    def net(gray: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        features = torch.ones(1, 128, -(-gray.shape[2] // 4), -(-gray.shape[3] // 4))
        return gray[:, 0] / 255, features

    monkeypatch.setattr(aslfeat.AslFeat, "network", lambda *_: (net, torch.device("cpu")))
    y, x = np.mgrid[:500, :1000] + 0.5
    spot = 250 * np.exp(-((x - 700.5) ** 2 + (y - 300.5) ** 2) / (2 * 5.0**2))
    image = np.repeat(spot.round().astype(np.uint8)[..., None], 3, axis=2)
    options = {"multi_scale": True, "threshold": 0.4}
    result = plugin(AslFeat, random_weights["aslfeat"], **options).extract(image)
    assert len(result.scores) == 3
    np.testing.assert_allclose(result.keypoints_px[:, :2], [[700.5, 300.5]] * 3, atol=0.1)


def tensorflows_variables() -> dict[str, np.ndarray]:
    with np.load(TENSORFLOW / "variables.npz") as written:
        return dict(written)


def converted() -> dict[str, torch.Tensor]:
    return aslfeat_state(tensorflows_variables())


def test_conversion_ignores_the_state_of_the_optimiser() -> None:
    variables = tensorflows_variables()
    slots = {
        "conv0/kernel/Momentum": variables["conv0/kernel"],
        "deform_param/conv6/offset/bias/Adam_1": np.zeros(18),
    }
    assert aslfeat_state(variables | slots).keys() == converted().keys()


def test_strips_give_the_same_peakiness(monkeypatch: pytest.MonkeyPatch) -> None:
    features = torch.randn(6, 20, 11, generator=torch.Generator().manual_seed(1))
    whole = peakiness(features, 3, torch.tensor(1.0))
    monkeypatch.setitem(aslfeat._VALUES_AT_ONCE, "cpu", 3 * 11 * 6)
    torch.testing.assert_close(peakiness(features, 3, torch.tensor(1.0)), whole, rtol=0, atol=1e-6)


ROWS, COLUMNS = torch.meshgrid(*[torch.arange(41.0, dtype=torch.float64) - 20] * 2, indexing="ij")
CENTRE = torch.tensor([[20, 20]])


@pytest.mark.parametrize(
    ("length_px", "max_ratio", "kept"),
    [(4.0, 10.0, True), (9.0, 10.0, True), (30.0, 10.0, False), (9.0, 2.0, False)],
)
def test_long_blobs_are_edges(length_px: float, max_ratio: float, kept: bool) -> None:
    blob = torch.exp(-((COLUMNS / 4) ** 2 + (ROWS / length_px) ** 2) / 2)
    assert on_no_edge(blob, CENTRE, max_ratio).tolist() == [kept]


def test_saddles_and_flat_regions_are_rejected() -> None:
    for scores in (COLUMNS**2 - ROWS**2, torch.ones(41, 41)):
        assert not on_no_edge(scores, CENTRE, 10.0).any()


def test_the_coarsest_level_equals_the_published_keypoints(shared_data: Path) -> None:
    """virtual_gallery has the best 500 keypoints of three levels."""
    folder = KaptureFolder(shared_data / "foreign_maps" / "virtual_gallery" / "query")
    name = folder.read().image_names()[0]
    stored = folder.keypoints("r2d2_500").read(name)
    descriptors = folder.descriptors("r2d2_500").read(name)
    coarsest = stored[:, 2] > 85
    stored, descriptors = stored[coarsest][::-1], descriptors[coarsest][::-1]  # worst came first
    assert len(stored) > 80

    options = {"max_keypoints": len(stored), "min_size": 580, "max_size": 700}
    r2d2 = plugin(R2D2, shared_data / "weights" / "r2d2" / "r2d2_WASF_N16.pt", **options)
    result = r2d2.extract(read_image_rgb(folder.image_path(name)))
    # stored keypoints count from the centre of each level's first pixel, not from its corner
    ratio = np.array([1920 / 679, 1080 / 382], np.float32)
    offset = result.keypoints_px[:, None, :2] - (stored[:, :2] + ratio / 2)
    distance = np.linalg.norm(offset, axis=2)
    nearest = distance.argmin(axis=0)
    assert len(np.unique(nearest)) == len(stored)
    assert distance.min(axis=0).max() < 0.01
    cosine = (result.descriptors[nearest] * descriptors).sum(axis=1)
    assert cosine.min() > 0.999
    # in the same order, but for scores that are all but equal
    assert np.abs(nearest - np.arange(len(stored))).max() <= 2
    np.testing.assert_allclose(result.keypoints_px[:, 2], stored[0, 2], rtol=1e-3)


def test_sizes_without_a_level_between_them_are_refused() -> None:
    with pytest.raises(ValidationError, match=r"max_size must be at least 1\.2 times min_size"):
        R2D2Options(min_size=1000, max_size=1024)


@pytest.mark.parametrize(
    ("size", "limits", "expected"),
    [
        # width and height, four levels an octave
        (
            (640, 480),
            (256, 1024),
            [(640, 480), (538, 404), (453, 339), (381, 285), (320, 240), (269, 202)],
        ),
        # levels above the limit are computed, not returned
        ((1920, 1080), (600, 1024), [(960, 540), (807, 454), (679, 382)]),
        # an image smaller than the limits is used as it is
        ((80, 60), (256, 1024), [(80, 60)]),
    ],
)
def test_levels_of_the_pyramid(size: Any, limits: Any, expected: list[tuple[int, int]]) -> None:
    image = torch.zeros(1, 1, *size[::-1])
    levels = pyramid_levels(image, min_size=limits[0], max_size=limits[1])
    assert [(level.shape[-1], level.shape[-2]) for level in levels] == expected


ALL = 100_000


@pytest.fixture(autouse=True)
def _no_download(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("kornia downloads")

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", refuse)
    monkeypatch.setattr(kornia.core.download, "load_state_dict_from_url", refuse)


def test_xfeat_equals_kornia_shifted_by_half_a_pixel(shared_data: Path, photograph: Image) -> None:
    image = np.ascontiguousarray(photograph[300:428, 400:560])
    theirs = KorniaXFeat(top_k=ALL).eval()
    file = shared_data / "weights" / "xfeat" / "xfeat.pt"
    theirs.net.load_state_dict(read_weights(find_weights(str(file))))
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
    expected = {key: value.numpy() for key, value in theirs.detectAndCompute(tensor)[0].items()}
    result = plugin(XFeat, file, max_keypoints=ALL).extract(image)
    # theirs has the first pixel's centre at (0, 0)
    ours = np.lexsort(result.keypoints_px[:, :2].T)
    order = np.lexsort(expected["keypoints"].T)
    np.testing.assert_array_equal(result.keypoints_px[ours, :2] - 0.5, expected["keypoints"][order])
    np.testing.assert_allclose(result.descriptors[ours], expected["descriptors"][order], atol=1e-4)
    # the same weights as separate descriptor weights give the same descriptors
    both = plugin(XFeat, file, max_keypoints=ALL, descriptor_weights=str(file))
    again = both.extract(image)
    np.testing.assert_allclose(again.descriptors, result.descriptors, atol=1e-4)


def test_keypoints_of_an_enlarged_image_stay(shared_data: Path, photograph: Image) -> None:
    """OpenCV enlarges by 47 % in COLMAP's coordinates; XFeat resizes to multiples of 32."""
    small = np.ascontiguousarray(photograph[300:364, 200:264])
    large = cv2.resize(small, (94, 94), interpolation=cv2.INTER_LINEAR)
    xfeat = plugin(XFeat, shared_data / "weights" / "xfeat" / "xfeat.pt", max_keypoints=ALL)
    a = xfeat.extract(small).keypoints_px[:, :2]
    b = xfeat.extract(np.asarray(large, np.uint8)).keypoints_px[:, :2] * 64 / 94
    distance = np.linalg.norm(a[:, None] - b, axis=2)
    result = distance.min(axis=1) < 1.5
    assert result.sum() > 20
    offset = (b[distance.argmin(axis=1)] - a)[result]
    # a missing half pixel would shift the median by (1 - 64 / 94) / 2 = 0.16
    assert np.abs(np.median(offset, axis=0)).max() < 1e-3
    assert np.abs(offset.mean(axis=0)).max() < 0.12


def test_disk_of_a_local_file_equals_kornia(tmp_path: Path, photograph: Image) -> None:
    torch.manual_seed(0)
    network = DISK().eval()
    torch.save({"extractor": network.state_dict()}, tmp_path / "depth-save.pth")
    image = np.ascontiguousarray(photograph[300:364, 400:480])
    mask = np.ones(image.shape[:2], bool)
    mask[:, :40] = False
    disk = plugin(Disk, tmp_path / "depth-save.pth", max_keypoints=10)
    result = disk.extract(image, mask)
    assert result.keypoints_px.shape == (10, 3) and result.descriptors.shape == (10, 128)
    assert result.keypoints_px[:, 0].min() > 40 and result.num_masked > 0
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
    with torch.inference_mode():
        theirs = network(tensor, pad_if_not_divisible=True)[0]
    known = {tuple(xy) for xy in (theirs.keypoints.numpy() + 0.5).tolist()}
    assert {tuple(xy) for xy in result.keypoints_px[:, :2].tolist()} <= known

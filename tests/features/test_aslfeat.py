"""ASLFeat keypoints: hand-made score maps, random weights, and TensorFlow's keypoints."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.features import aslfeat
from megloc_kapture.features.aslfeat import AslFeat, AslFeatOptions
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.nets.aslfeat import AslFeatMaps
from megloc_kapture.values import LocalFeatures

Image = NDArray[np.uint8]
NETS = Path(__file__).parent.parent / "nets"
VARIABLES = NETS / "keys" / "aslfeat.txt"
TENSORFLOW = NETS / "data" / "aslfeat"  # what make_reference.py of it has written


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights that answer to texture, TensorFlow's names and layouts."""
    rng = np.random.default_rng(0)
    arrays = {}
    for row in VARIABLES.read_text().splitlines():
        name, text = row.split()
        shape = () if text == "scalar" else tuple(map(int, text.split("x")))
        values = rng.normal(size=shape)
        if name.startswith("deform_param"):
            values = values * 0.02
        elif name.endswith("kernel"):
            values = values * (2 / (9 * shape[2])) ** 0.5
        elif name.endswith("moving_mean"):
            values = values * 0.1
        else:
            values = np.abs(values) * 0.5 + (0.5 if shape else 2)
        arrays[name] = values.astype(np.float32)
    arrays["global_step"] = np.array(380_000)
    path = tmp_path_factory.mktemp("weights") / "aslfeat.npz"
    np.savez(path, **arrays)
    return path


@pytest.fixture
def extractor(checkpoint: Path) -> AslFeat:
    return AslFeat(AslFeatOptions(weights=str(checkpoint), device="cpu"))


def with_options(checkpoint: Path, **options: object) -> AslFeat:
    given = {"weights": str(checkpoint), "device": "cpu", **options}
    return AslFeat(AslFeatOptions.model_validate(given))


def texture(size: tuple[int, int] = (150, 203), seed: int = 0) -> Image:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, size[0] // 6 + 2, size[1] // 6 + 2, generator=generator)
    fine = torch.nn.functional.interpolate(coarse, size, mode="bicubic").clamp(0, 1)
    return (fine[0] * 255).byte().permute(1, 2, 0).numpy().copy()


def assert_same(a: LocalFeatures, b: LocalFeatures) -> None:
    np.testing.assert_array_equal(a.keypoints_px, b.keypoints_px)
    np.testing.assert_array_equal(a.scores, b.scores)
    np.testing.assert_array_equal(a.descriptors, b.descriptors)


def on_maps(
    monkeypatch: pytest.MonkeyPatch,
    checkpoint: Path,
    scores: torch.Tensor,
    features: torch.Tensor | None = None,
    **options: object,
) -> LocalFeatures:
    """What is extracted where the network answers with these maps."""
    height, width = scores.shape
    if features is None:
        features = torch.ones(128, -(-height // 4), -(-width // 4))
    given = (lambda _: [AslFeatMaps(scores, features)]), torch.device("cpu")
    monkeypatch.setattr(aslfeat.AslFeat, "network", lambda *_: given)
    image = np.zeros((height, width, 3), np.uint8)
    image[0] = 255  # an image without any contrast is not looked at
    return with_options(checkpoint, **options).extract(image)


def blobs(centres: list[tuple[float, float]], heights: list[float]) -> torch.Tensor:
    """Score map of 60 x 80 with round peaks of 2 px around (x, y), integers at pixel centres."""
    rows, columns = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    scores = torch.full((60, 80), 0.1)
    for (x, y), height in zip(centres, heights, strict=True):
        scores += (height - 0.1) * torch.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8)
    return scores


def test_the_centre_of_a_blob(monkeypatch: pytest.MonkeyPatch, checkpoint: Path) -> None:
    # a blob on a pixel's centre lies a half further in COLMAP's coordinates
    centres = [(20.0, 30.0), (50.3, 20.0), (60.25, 45.6)]
    found = on_maps(monkeypatch, checkpoint, blobs(centres, [2.0, 1.5, 1.0]))
    assert len(found.scores) == 3
    expected = np.array(centres) + 0.5
    assert np.abs(found.keypoints_px[:, :2] - expected).max() < 0.05
    np.testing.assert_allclose(found.keypoints_px[0, :2], [20.5, 30.5], atol=1e-4)
    np.testing.assert_allclose(found.scores[0], 2.0, atol=1e-3)


def test_weak_peaks_and_peaks_at_the_border_are_left_out(
    monkeypatch: pytest.MonkeyPatch, checkpoint: Path
) -> None:
    centres = [(4.0, 30.0), (5.0, 45.0), (75.0, 20.0), (74.0, 40.0), (40.0, 30.0)]
    scores = blobs(centres, [2.0, 1.5, 2.0, 1.2, 0.4])
    found = on_maps(monkeypatch, checkpoint, scores)
    np.testing.assert_allclose(found.keypoints_px[:, :2], [[5.5, 45.5], [74.5, 40.5]], atol=0.01)


def test_a_flat_map_and_a_straight_edge_give_nothing(
    monkeypatch: pytest.MonkeyPatch, checkpoint: Path
) -> None:
    assert len(on_maps(monkeypatch, checkpoint, torch.ones(60, 80)).scores) == 0
    edge = torch.ones(60, 80)
    edge += 2 * torch.exp(-((torch.arange(80.0) - 40) ** 2) / 8)
    assert len(on_maps(monkeypatch, checkpoint, edge).scores) == 0
    assert len(on_maps(monkeypatch, checkpoint, edge.T.contiguous()).scores) == 0


def test_a_descriptor_is_read_at_a_quarter_of_the_pixel(
    monkeypatch: pytest.MonkeyPatch, checkpoint: Path
) -> None:
    rows, columns = torch.meshgrid(torch.arange(15.0), torch.arange(20.0), indexing="ij")
    features = torch.zeros(128, 15, 20)
    features[0], features[1], features[2] = rows, columns, 1.0
    x, y = 41.2, 22.3
    found = on_maps(monkeypatch, checkpoint, blobs([(x, y)], [2.0]), features)
    descriptor = found.descriptors[0]
    assert np.linalg.norm(descriptor) == pytest.approx(1, abs=1e-6)
    at = found.keypoints_px[0, :2] - 0.5
    np.testing.assert_allclose(descriptor[:2] / descriptor[2], at[::-1] / 4, atol=1e-4)


@pytest.mark.parametrize("size", [(96, 128), (75, 101)])
def test_random_weights_run_through_everything(extractor: AslFeat, size: tuple[int, int]) -> None:
    found = extractor.extract(texture(size))
    assert len(found.scores) > 20
    assert found.keypoints_px.dtype == found.scores.dtype == np.float32
    assert found.descriptors.shape == (len(found.scores), 128)
    assert found.descriptors.dtype == np.dtype(extractor.descriptor_dtype)
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-5)
    np.testing.assert_array_equal(found.keypoints_px[:, 2], found.scores)
    x, y = found.keypoints_px[:, :2].T
    assert x.min() > 5 and y.min() > 5 and x.max() < size[1] - 5 and y.max() < size[0] - 5
    assert (np.diff(found.scores) <= 0).all() and found.scores.min() > 0.5


def test_a_shift_by_the_stride_moves_the_keypoints(checkpoint: Path) -> None:
    whole = texture((300, 340))
    dx, dy = 8, 4
    extractor = with_options(checkpoint, max_keypoints=100_000)
    first = extractor.extract(whole[40:240, 40:280].copy()).keypoints_px
    second = extractor.extract(whole[40 - dy : 240 - dy, 40 - dx : 280 - dx].copy()).keypoints_px
    # each image is normalised by its own mean and contrast, so the scores differ a little
    inside = ((first[:, :2] > 60) & (first[:, :2] < [180, 140])).all(axis=1)
    expected = first[inside, :2] + (dx, dy)
    nearest = np.linalg.norm(expected[:, None] - second[None, :, :2], axis=2).min(axis=1)
    assert inside.sum() > 20
    assert np.median(nearest) < 0.05
    assert (nearest < 0.5).mean() > 0.9


def test_the_best_are_kept_and_the_mask_comes_first(checkpoint: Path) -> None:
    image = texture()
    every = with_options(checkpoint, max_keypoints=100_000).extract(image)
    some = with_options(checkpoint, max_keypoints=20).extract(image)
    np.testing.assert_array_equal(some.keypoints_px, every.keypoints_px[:20])
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[60:, :] = True
    masked = with_options(checkpoint, max_keypoints=20).extract(image, mask)
    x, y = np.floor(every.keypoints_px[:, :2]).astype(int).T
    allowed = mask[y, x]
    assert 20 < allowed.sum() < len(allowed)
    np.testing.assert_array_equal(masked.keypoints_px, every.keypoints_px[allowed][:20])
    assert masked.num_masked == (~allowed).sum() and every.num_masked == 0


def test_several_scales_add_keypoints(checkpoint: Path) -> None:
    image = texture((300, 400))
    one = with_options(checkpoint, max_keypoints=100_000).extract(image)
    several = with_options(checkpoint, max_keypoints=100_000, multi_scale=True).extract(image)
    assert len(several.scores) > len(one.scores)
    # those of the whole image are among them, unchanged
    known = {tuple(row) for row in several.keypoints_px.tolist()}
    assert {tuple(row) for row in one.keypoints_px.tolist()} <= known
    assert (np.diff(several.scores) <= 0).all()
    assert several.keypoints_px[:, 0].max() < 400 and several.keypoints_px[:, 1].max() < 300


@pytest.mark.parametrize("image", ["even", "odd"])
def test_keypoints_are_tensorflows(image: str) -> None:
    outputs = np.load(TENSORFLOW / "reference.npz")
    gray = outputs[f"{image}/image"]
    found = with_options(TENSORFLOW / "aslfeat.tar.gz").extract(np.repeat(gray[..., None], 3, 2))
    assert len(found.scores) > 40
    # the published network puts the first pixel's centre at (0, 0)
    np.testing.assert_allclose(
        found.keypoints_px[:, :2] - 0.5, outputs[f"{image}/keypoints"], rtol=0, atol=1e-4
    )
    np.testing.assert_allclose(found.scores, outputs[f"{image}/scores"], rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        found.descriptors, outputs[f"{image}/descriptors"], rtol=0, atol=1e-5
    )


# 0.3 of the size, and of the longer side 128 pixels, is the smallest; each level is 1/sqrt(2)
@pytest.mark.parametrize(
    ("longer", "sizes"),
    [
        (100, [(50, 100)]),
        (200, [(100, 200)]),
        (300, [(150, 300), (106, 212)]),
        (1000, [(500, 1000), (354, 707), (250, 500)]),
    ],
)
def test_sizes_of_the_scales(longer: int, sizes: list[tuple[int, int]]) -> None:
    gray = np.random.default_rng(0).uniform(0, 255, (longer // 2, longer)).astype(np.float32)
    assert [level.shape for level in aslfeat._scales(gray)] == sizes


def test_keypoints_of_small_scales_lie_where_they_are_in_the_image(
    monkeypatch: pytest.MonkeyPatch, checkpoint: Path
) -> None:
    # the network marks the brightest pixel of what it is given: a spot is found on every scale
    def net(gray: torch.Tensor) -> list[AslFeatMaps]:
        features = torch.ones(128, -(-gray.shape[2] // 4), -(-gray.shape[3] // 4))
        return [AslFeatMaps(gray[0, 0] / 255, features)]

    monkeypatch.setattr(aslfeat.AslFeat, "network", lambda *_: (net, torch.device("cpu")))
    y, x = np.mgrid[:500, :1000] + 0.5
    spot = 250 * np.exp(-((x - 700.5) ** 2 + (y - 300.5) ** 2) / (2 * 5.0**2))
    image = np.repeat(spot.round().astype(np.uint8)[..., None], 3, axis=2)
    found = with_options(checkpoint, multi_scale=True, threshold=0.4).extract(image)
    assert len(found.scores) == 3
    np.testing.assert_allclose(found.keypoints_px[:, :2], [[700.5, 300.5]] * 3, atol=0.1)


def test_two_runs_give_the_same_also_after_pickling(extractor: AslFeat) -> None:
    image = texture()
    again = pickle.loads(pickle.dumps(extractor))
    assert len(pickle.dumps(extractor)) < 2000
    assert_same(extractor.extract(image), again.extract(image.copy()))


@pytest.mark.parametrize("shape", [(1, 1, 3), (10, 40, 3), (11, 11, 3), (64, 48, 3)])
def test_an_image_without_texture_has_no_features(
    extractor: AslFeat, shape: tuple[int, int, int]
) -> None:
    features = extractor.extract(np.full(shape, 90, dtype=np.uint8))
    assert features.keypoints_px.shape == (0, 3) and features.keypoints_px.dtype == np.float32
    assert features.scores.shape == (0,)
    assert features.descriptors.shape == (0, 128) and features.descriptors.dtype == np.float32


@pytest.mark.parametrize("size", [(8, 30), (11, 11), (11, 200), (13, 12)])
def test_the_smallest_images(checkpoint: Path, size: tuple[int, int]) -> None:
    extractor = with_options(checkpoint, threshold=0.0)
    image = np.random.default_rng(1).integers(0, 255, (*size, 3)).astype(np.uint8)
    features = extractor.extract(image)
    assert features.keypoints_px.shape == (len(features.scores), 3)


def test_half_precision_finds_about_the_same(checkpoint: Path) -> None:
    image = texture()
    full = with_options(checkpoint).extract(image).keypoints_px
    half = with_options(checkpoint, half_precision=True).extract(image).keypoints_px
    assert half.dtype == np.float32
    nearest = np.linalg.norm(full[:, None, :2] - half[None, :, :2], axis=2).min(axis=1)
    assert (nearest < 1).mean() > 0.7


def test_missing_weights_say_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(tmp_path))
    with pytest.raises(MissingWeightsError, match="aslfeat"):
        AslFeat()


def test_a_file_of_another_network_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", **{"conv1/kernel": np.zeros((3, 3, 1, 1), np.float32)})
    extractor = with_options(tmp_path / "other.npz")
    with pytest.raises(DataError, match=r"other\.npz"):
        extractor.extract(texture((40, 40)))


def test_weights_are_named_by_their_sha256(extractor: AslFeat) -> None:
    found = extractor.weights()
    assert list(found) == ["aslfeat.npz"] and len(found["aslfeat.npz"]) == 64

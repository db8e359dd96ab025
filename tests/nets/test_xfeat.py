"""XFeat's network against its ONNX export, run by onnxruntime, and against kornia's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from kornia.feature.xfeat import InterpolateSparse2d
from kornia.feature.xfeat import XFeat as KorniaXFeat
from numpy.typing import NDArray
from PIL import Image
from published import published_shapes

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.nets.xfeat import XFeatNetwork, keypoint_scores, load_xfeat, sample_at_pixels


def random_tensors(seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {
        key: torch.rand(shape, generator=generator) + 0.1 * key.endswith("running_var")
        for key, shape in published_shapes("xfeat").items()
    }


@pytest.fixture(scope="module")
def published(shared_data: Path) -> dict[str, torch.Tensor]:
    return read_weights(find_weights(str(shared_data / "weights" / "xfeat" / "xfeat.onnx")))


@pytest.fixture(scope="module")
def photograph(shared_data: Path) -> NDArray[np.float32]:
    """A real image, grey, (1, 1, 1024, 1280), of mean 0 and variance 1.

    onnxruntime's own normalisation of a grey image loses three digits to a variance in one pass;
    of an image that is normalised already it does not.
    """
    folder = shared_data / "scenes" / "fountain_p11" / "mapping" / "sensors" / "records_data"
    grey = np.asarray(Image.open(folder / "0003.jpg").convert("L"))[:1024, :1280]
    return ((grey - grey.mean()) / grey.std()).astype(np.float32)[None, None]


# ------------------------------------------------------------------ keys


def test_keys_and_shapes_are_the_published_ones() -> None:
    found = {
        key: tuple(value.shape)
        for key, value in XFeatNetwork().state_dict().items()
        if not key.endswith("num_batches_tracked")
    }
    assert found == published_shapes("xfeat")
    assert sum(int(np.prod(shape)) for shape in found.values()) == 660_654


def test_a_fine_matcher_and_counters_are_no_fault() -> None:
    tensors = random_tensors()
    matcher = {"fine_matcher.0.weight": torch.zeros(512, 128)}
    counters = {
        key: torch.tensor(7)
        for key in XFeatNetwork().state_dict()
        if key.endswith("num_batches_tracked")
    }
    state = load_xfeat(tensors | matcher | counters, "xfeat.pt").state_dict()
    for key, value in (tensors | counters).items():
        torch.testing.assert_close(state[key], value)


def test_what_does_not_fit_is_named() -> None:
    tensors = random_tensors()
    lost = tensors.pop("block4.1.layer.0.weight")
    with pytest.raises(DataError, match=r"x\.pt: .*missing keys: block4\.1\.layer\.0\.weight"):
        load_xfeat(tensors, "x.pt")
    with pytest.raises(DataError, match=r"unexpected keys: block9\.weight"):
        load_xfeat(tensors | {"block4.1.layer.0.weight": lost, "block9.weight": lost}, "x.pt")
    with pytest.raises(DataError, match=r"block4\.1\.layer\.0\.weight is \(32, 64, 3, 3\)"):
        load_xfeat(tensors | {"block4.1.layer.0.weight": lost[:32]}, "x.pt")


# ------------------------------------------------------------------ the dense maps


def test_the_maps_are_those_of_the_onnx_file(
    shared_data: Path, published: dict[str, torch.Tensor], photograph: NDArray[np.float32]
) -> None:
    session = onnxruntime.InferenceSession(
        shared_data / "weights" / "xfeat" / "xfeat.onnx", providers=["CPUExecutionProvider"]
    )
    expected = session.run(None, {"l_x_": photograph})
    with torch.inference_mode():
        found = load_xfeat(published, "xfeat.onnx")(torch.from_numpy(photograph))
    # features to 7, logits to 25, reliability to 1
    for ours, theirs, tolerance in zip(found, expected, (2e-3, 2e-3, 1e-4), strict=True):
        assert ours.shape == theirs.shape
        np.testing.assert_allclose(ours.numpy(), theirs, atol=tolerance, rtol=0)


def test_the_maps_are_kornias_for_any_size_and_for_colour() -> None:
    tensors = random_tensors(1)
    theirs = KorniaXFeat().eval()
    counters = ("num_batches_tracked", "fine_matcher")
    missing, unexpected = theirs.net.load_state_dict(tensors, strict=False)
    assert not unexpected and all(any(word in key for word in counters) for key in missing)
    image = torch.rand(2, 3, 96, 160, generator=torch.Generator().manual_seed(2))
    with torch.inference_mode():
        expected = theirs.net(image)
        found = load_xfeat(tensors, "x")(image)
    for ours, other in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, other, rtol=1e-4, atol=1e-4)


# ------------------------------------------------------------------ what is read off them


def test_a_channel_of_the_logits_is_a_pixel_of_its_cell() -> None:
    logits = torch.zeros(1, 65, 3, 4)
    logits[0, 64] = 50.0  # no keypoint, but for two cells
    logits[0, 8 * 5 + 2, 1, 3] = 100.0
    logits[0, 0, 2, 0] = 100.0
    scores = keypoint_scores(logits)
    assert scores.shape == (1, 1, 24, 32)
    found = {(int(y), int(x)) for y, x in torch.nonzero(scores[0, 0] > 0.5)}
    assert found == {(1 * 8 + 5, 3 * 8 + 2), (2 * 8, 0)}


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
def test_sampling_is_kornias(mode: str) -> None:
    generator = torch.Generator().manual_seed(3)
    values = torch.rand(1, 5, 12, 16, generator=generator)
    xy = torch.stack(
        [
            torch.randint(0, 128, (200,), generator=generator),
            torch.randint(0, 96, (200,), generator=generator),
        ],
        dim=1,
    )
    expected = InterpolateSparse2d(mode)(values, xy[None], H=96, W=128)[0]
    torch.testing.assert_close(sample_at_pixels(values, xy, (96, 128), mode=mode), expected)


def test_sampling_a_ramp_gives_the_documented_position() -> None:
    ramp = torch.arange(16.0).expand(1, 1, 12, 16)
    x = torch.arange(8, 120, 7)
    found = sample_at_pixels(ramp, torch.stack([x, x * 0 + 40], 1), (96, 128), mode="bilinear")
    torch.testing.assert_close(found[:, 0], 16 * x / 127 - 0.5)
    # half a pixel, a sixteenth of a cell, from where the pixel's centre is on the map, or nearer
    exact = (x + 0.5) / 8 - 0.5
    assert 0.01 < (found[:, 0] - exact).abs().max() <= 1 / 16

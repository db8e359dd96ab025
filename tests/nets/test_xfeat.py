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
from published import random_tensors

from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.nets.xfeat import XFeatNetwork, load_xfeat, sample_at_pixels


@pytest.fixture(scope="module")
def photograph(shared_data: Path) -> NDArray[np.float32]:
    """A real image, grey, (1, 1, 1024, 1280), of mean 0 and variance 1.

    onnxruntime's own normalisation of a grey image loses three digits to a variance in one pass;
    of an image that is normalised already it does not.
    """
    folder = shared_data / "scenes" / "fountain_p11" / "mapping" / "sensors" / "records_data"
    grey = np.asarray(Image.open(folder / "0003.jpg").convert("L"))[:1024, :1280]
    return ((grey - grey.mean()) / grey.std()).astype(np.float32)[None, None]


def test_a_fine_matcher_and_counters_are_no_fault() -> None:
    tensors = random_tensors("xfeat")
    matcher = {"fine_matcher.0.weight": torch.zeros(512, 128)}
    counters = {
        key: torch.tensor(7)
        for key in XFeatNetwork().state_dict()
        if key.endswith("num_batches_tracked")
    }
    state = load_xfeat(tensors | matcher | counters, "xfeat.pt").state_dict()
    for key, value in (tensors | counters).items():
        torch.testing.assert_close(state[key], value)


def test_the_maps_are_those_of_the_onnx_file(
    shared_data: Path, photograph: NDArray[np.float32]
) -> None:
    file = shared_data / "weights" / "xfeat" / "xfeat.onnx"
    published = read_weights(find_weights(str(file)))
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    expected = session.run(None, {"l_x_": photograph})
    with torch.inference_mode():
        found = load_xfeat(published, "xfeat.onnx")(torch.from_numpy(photograph))
    # features to 7, logits to 25, reliability to 1
    for ours, theirs, tolerance in zip(found, expected, (2e-3, 2e-3, 1e-4), strict=True):
        assert ours.shape == theirs.shape
        np.testing.assert_allclose(ours.numpy(), theirs, atol=tolerance, rtol=0)


def test_the_maps_are_kornias_for_any_size_and_for_colour() -> None:
    tensors = random_tensors("xfeat", 1)
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

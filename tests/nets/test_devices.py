"""Networks on an emulated GPU: device of all tensors, half precision."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from emulated_device import emulated_devices
from numpy.typing import NDArray
from published import random_features, randomised, seen_again
from whole_preset_weights import Sizes, write_random_weights

from megloc_kapture.features import global_networks
from megloc_kapture.features.aliked import Aliked
from megloc_kapture.features.aslfeat import AslFeat
from megloc_kapture.features.kornia_features import Disk, XFeat
from megloc_kapture.features.r2d2 import R2D2
from megloc_kapture.features.superpoint import SuperPoint
from megloc_kapture.io.weights import UNVERIFIED
from megloc_kapture.localization import lpips
from megloc_kapture.matching.networks import LightGlue, SuperGlue
from megloc_kapture.nets import runtime
from megloc_kapture.preprocessing.deeplab import DeepLab, DeepLabV3Plus

DEVICE = "cuda:1"
HEIGHT, WIDTH = 64, 96
SLOW = pytest.mark.slow
EXTRACTORS: dict[str, tuple[Any, dict[str, Any]]] = {
    "superpoint_v1": (SuperPoint, {}),
    "aslfeat": (AslFeat, {}),
    "aliked-n16": (Aliked, {"threshold": 0.0}),
    "r2d2_WASF_N16": (R2D2, {"min_size": 60, "max_size": 72}),
    "xfeat": (XFeat, {}),
    "disk": (Disk, {}),
}
GLOBAL: dict[str, tuple[Any, dict[str, Any]]] = {
    "openibl": (global_networks.OpenIbl, {"max_size_px": 64}),
    "apgem-resnet101-lm18": (global_networks.ApGem, {}),
    "delg-r101-gldv2clean": (global_networks.Delg, {"scales": [1.0]}),
}
HEAVY = {"apgem-resnet101-lm18", "delg-r101-gldv2clean"}
MATCHERS = {"superglue_outdoor": SuperGlue, "superpoint_lightglue": LightGlue}


def keep_four_layers(path: Path) -> None:
    state = torch.load(path, weights_only=True)
    for key in list(state):
        layer = next((int(part) for part in key.split(".") if part.isdigit()), 0)
        # the confidence of the last layer is not used
        last = 2 if key.startswith("token_confidence.") else 3
        of_layer = ("gnn.layers.", "transformers.", "log_assignment.", "token_confidence.")
        if key.startswith(of_layer) and layer > last:
            del state[key]
    torch.save(state, path)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., None]]:
    """Writes random weights where networks find them, each file once."""
    folder = tmp_path_factory.mktemp("weights")

    def write(*names: str) -> None:
        for name in names:
            if name not in written:
                sizes = Sizes(clusters=4, whitened=32, hidden=8)
                paths = write_random_weights(folder / UNVERIFIED, sizes=sizes, names=[name])
                if name in MATCHERS:
                    keep_four_layers(paths[name])
                written.add(name)

    written: set[str] = set()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MEGLOC_WEIGHTS", str(folder))
        yield write


@pytest.fixture
def image() -> NDArray[np.uint8]:
    coarse = np.random.default_rng(0).integers(0, 256, (HEIGHT // 4, WIDTH // 4, 3), np.uint8)
    return coarse.repeat(4, axis=0).repeat(4, axis=1)


def forget() -> None:
    for kept in (*vars(runtime).values(), *vars(lpips).values()):
        if hasattr(kept, "cache_clear"):
            kept.cache_clear()


def on_both(
    kind: Any, options: dict[str, Any], run: Callable[[Any], Any], *, half: bool = True
) -> tuple[Any, Any]:
    """Return results of a plugin on the CPU, in full precision, and on the emulated device."""
    on_cpu = run(kind(kind.Options.model_validate({**options, "device": "cpu"})))
    forget()
    torch.manual_seed(0)
    try:
        with emulated_devices():
            wanted = {**options, "device": DEVICE, "half_precision": half}
            return on_cpu, run(kind(kind.Options.model_validate(wanted)))
    finally:
        forget()


@pytest.mark.parametrize("name", EXTRACTORS)
def test_local_features(name: str, weights: Callable[..., None], image: NDArray[np.uint8]) -> None:
    weights(name)
    kind, options = EXTRACTORS[name]
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:, :20] = False
    images, masks = [image, image[::-1].copy()], [mask, None]
    cpu, result = on_both(
        kind, options | {"max_keypoints": 200}, lambda p: p.extract_many(images, masks)
    )
    for exact, half in zip(cpu, result, strict=True):
        assert len(exact.scores) > 20
        apart = np.linalg.norm(exact.keypoints_px[:, None, :2] - half.keypoints_px[:, :2], axis=2)
        near = apart.min(axis=1) < 1.0
        cosine = (exact.descriptors * half.descriptors[apart.argmin(axis=1)]).sum(axis=1)
        assert near.mean() > 0.5
        assert np.median(cosine[near]) > 0.95


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=SLOW if name in HEAVY else ()) for name in GLOBAL]
)
def test_global_features(name: str, weights: Callable[..., None], image: NDArray[np.uint8]) -> None:
    weights(name)
    kind, options = GLOBAL[name]
    cpu, result = on_both(kind, options, lambda p: p.describe_many([image, image[::-1].copy()]))
    cosine = (cpu * result).sum(axis=1)
    assert cosine.min() > 0.95


@pytest.mark.parametrize("name", MATCHERS)
def test_matches(name: str, weights: Callable[..., None]) -> None:
    weights(name)
    a, less, none = (random_features(number, 256, number) for number in (40, 1, 0))
    b = seen_again(a, 0, kept=30, new=0, noise=0.0)
    options = {"sinkhorn_iterations": 2} if name == "superglue_outdoor" else {}
    cpu, result = on_both(MATCHERS[name], options, lambda p: p.match_many(a, [b, less, none]))
    pairs = [set(map(tuple, matches.tolist())) for matches, _ in (cpu[0], result[0])]
    assert len(pairs[0]) > 20
    assert len(pairs[0] & pairs[1]) >= 0.9 * len(pairs[0] | pairs[1])
    assert len(result[2][0]) == 0


def test_labels(tmp_path: Path, image: NDArray[np.uint8]) -> None:
    """In full precision only: activations of random weights exceed float16."""
    network = randomised(DeepLabV3Plus("mobilenet", num_classes=19))
    torch.save({"model_state": network.state_dict()}, tmp_path / "mobilenet.pth")
    options = {"weights": str(tmp_path / "mobilenet.pth")}
    cpu, result = on_both(DeepLab, options, lambda p: p.segment(image), half=False)
    assert (cpu == result).mean() > 0.999 and len(np.unique(cpu)) > 1


def test_image_distance(weights: Callable[..., None], image: NDArray[np.uint8]) -> None:
    weights("lpips-trunk-alex", "lpips-alex")
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[:, :20] = False
    cpu, result = on_both(
        lpips.LpipsDistance, {}, lambda p: p.distance(image, image[::-1].copy(), valid)
    )
    assert cpu > 0 and result == pytest.approx(cpu, rel=0.02)

"""A segmenter of another package: installed by pip, found by entry point, on real photographs.

The package in ``outside_segmenter/`` is ESPNetv2. The plausible answers below were looked at in
pictures: the network knows streets, and takes much of anything else for something else.
"""

from __future__ import annotations

import pickle
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from megloc_kapture.errors import DataError, PluginError
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.plugin_loading import load_plugin, plugin_names, weights_of
from megloc_kapture.plugins import SEGMENTERS

pytestmark = pytest.mark.slow

SOURCE = Path(__file__).parent / "outside_segmenter"
WEIGHTS = "weights/espnetv2_cityscapes/espnetv2_s_1.0_city_1024x512.pth"
PHOTOGRAPHS = {
    "town hall": "kapture_samples/Aachen-Day-Night/images_upright/query/day/nexus4/"
    "IMG_20140520_211432.jpg",
    "street": "kapture_samples/Aachen-Day-Night/images_upright/db/4446.jpg",
    "church": "scenes/herzjesu_p25/mapping/sensors/records_data/0000.jpg",
    "fountain": "scenes/fountain_p11/mapping/sensors/records_data/0000.jpg",
}


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that pip has installed the package into."""
    folder = tmp_path_factory.mktemp("outside")
    # a build leaves files beside the sources
    shutil.copytree(SOURCE, folder / "source", ignore=shutil.ignore_patterns("__pycache__"))
    pip = [sys.executable, "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    alone = ["--no-index", "--no-deps", "--no-build-isolation", "--target", str(folder / "site")]
    done = subprocess.run(
        [*pip, *alone, str(folder / "source")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder / "site"


@pytest.fixture
def installed(target: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.syspath_prepend(target)
    yield target
    for module in [name for name in sys.modules if name.startswith("espnetv2_segmenter")]:
        del sys.modules[module]


@pytest.fixture
def segmenter(installed: Path, shared_data: Path) -> Any:
    return load_plugin(SEGMENTERS, "espnetv2", {"weights": str(shared_data / WEIGHTS)})


def share(labels: np.ndarray, segmenter: Any, *names: str) -> float:
    return float(np.isin(labels, [segmenter.classes.index(name) for name in names]).mean())


def test_pip_brings_a_segmenter(installed: Path) -> None:
    assert "espnetv2" in plugin_names(SEGMENTERS)
    with pytest.raises(PluginError, match=r"'espnetv2' refuses its options: weights"):
        load_plugin(SEGMENTERS, "espnetv2")
    with pytest.raises(DataError, match="nowhere.pth"):
        load_plugin(SEGMENTERS, "espnetv2", {"weights": str(installed / "nowhere.pth")})


def test_the_real_weights_fit_to_the_last_key(segmenter: Any, shared_data: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    labels = segmenter.segment(image)
    assert labels.shape == (48, 64) and labels.dtype == np.uint8
    # it travels to workers
    assert np.array_equal(pickle.loads(pickle.dumps(segmenter)).segment(image), labels)
    network = sys.modules["espnetv2_segmenter.network"].EspNetV2Network(20)
    stored = torch.load(shared_data / WEIGHTS, weights_only=True, map_location="cpu")
    own = network.state_dict()
    assert {key: value.shape for key, value in own.items()} == {
        key: value.shape for key, value in stored.items()
    }
    assert (len(own), sum(value.numel() for value in own.values())) == (526, 247_279)
    assert list(weights_of(segmenter)) == ["espnetv2_s_1.0_city_1024x512.pth"]


def test_weights_that_do_not_fit_are_refused_by_key(
    installed: Path, shared_data: Path, tmp_path: Path
) -> None:
    stored = torch.load(shared_data / WEIGHTS, weights_only=True, map_location="cpu")
    stored["bu_br_l9.0.weight"] = stored.pop("bu_br_l2.0.weight")
    torch.save(stored, tmp_path / "renamed.pth")
    plugin = load_plugin(SEGMENTERS, "espnetv2", {"weights": str(tmp_path / "renamed.pth")})
    with pytest.raises(DataError, match=r"renamed\.pth.*bu_br_l2\.0\.weight.*bu_br_l9\.0\.weight"):
        plugin.segment(np.zeros((32, 32, 3), np.uint8))


def test_photographs_of_streets_and_buildings(segmenter: Any, shared_data: Path) -> None:
    found = {
        name: segmenter.segment(read_image_rgb(shared_data / place))
        for name, place in PHOTOGRAPHS.items()
    }
    # the sky is above, what is walked on below, and not the other way round
    town = found["town hall"]
    top, bottom = town[: len(town) // 3], town[-len(town) // 5 :]
    ground = ("road", "sidewalk", "terrain")
    assert share(top, segmenter, "sky") > 0.2 > 0.01 > share(bottom, segmenter, "sky")
    for name, labels in found.items():
        least = 0.35 if name == "fountain" else 0.5
        assert share(labels, segmenter, "building") > least, name
        below, above = labels[-len(labels) // 10 :], labels[: len(labels) // 2]
        assert share(below, segmenter, *ground) > 0.25, name
        assert share(above, segmenter, *ground) < 0.02, name
    # plants grow on the wall beside the fountain, none in the shopping street
    assert share(found["fountain"], segmenter, "vegetation") > 0.3
    assert share(found["street"], segmenter, "vegetation") < 0.05
    # a walker is what masks leave out, the free road is not
    walker, free_road = found["street"][1210:1420, 850:900], found["street"][1400:1550, 350:600]
    assert share(walker, segmenter, *segmenter.dynamic) > 0.8
    assert share(free_road, segmenter, "road") > 0.8

"""Declarations of stages, ordered work, batches on a device, placement of networks."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from copy import copy
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.errors import MeglocError, OptionError, PluginError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.features.superpoint import SuperPointNet
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import ImagePair
from megloc_kapture.matching.nearest_neighbours import NearestNeighbours
from megloc_kapture.matching.verification import TwoViewOptions
from megloc_kapture.nets.runtime import pick_device
from megloc_kapture.pipeline.evaluation_plan import PIPELINE
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.plugin_loading import NetworkOptions, load_plugin
from megloc_kapture.plugins import LOCAL_FEATURES, MATCHERS, POSE_RANKERS
from megloc_kapture.stages import work as devices
from megloc_kapture.stages.local_features import (
    ExtractLocalFeatures,
    extract_all,
    extract_local_features,
)
from megloc_kapture.stages.matches import MatchQueries, match_all, match_pairs
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.query_poses import LocalizeQueries
from megloc_kapture.stages.stage import PipelineStage, StageWork, wanted_stages
from megloc_kapture.stages.work import Work, in_batches, is_out_of_memory, ordered_map
from megloc_kapture.values import ImageFeatures, LocalFeatures
from tests.worlds import folder_bytes

Image = NDArray[np.uint8]
NAMES = [f"{k}.jpg" for k in range(5)]


@pytest.fixture(scope="module")
def frames(shared_data: Path) -> list[tuple[Image, NDArray[np.bool_] | None]]:
    """Photographs of one size, the third with a mask."""
    folder = shared_data / "scenes" / "fountain_p11" / "mapping" / "sensors" / "records_data"
    found: list[tuple[Image, NDArray[np.bool_] | None]] = []
    for path in sorted(folder.rglob("*.jpg"))[:5]:
        small = cv2.resize(read_image_rgb(path), (144, 96), interpolation=cv2.INTER_AREA)
        found.append((np.asarray(small, np.uint8), None))
    half = np.zeros((96, 144), bool)
    half[:, :72] = True
    found[2] = found[2][0], half
    return found


@pytest.fixture(scope="module")
def random_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random checkpoint of SuperPoint, whose published weights are not free."""
    path = tmp_path_factory.mktemp("random") / "superpoint.pth"
    torch.manual_seed(1)
    torch.save(SuperPointNet().state_dict(), path)
    return path


@pytest.mark.parametrize("name", ["aliked", "xfeat", "r2d2", "superpoint"])
def test_features_of_a_batch(
    shared_data: Path, random_weights: Path, frames: Any, name: str
) -> None:
    of = {"aliked": "aliked/aliked-n16.pth", "xfeat": "xfeat/xfeat.pt"}
    of["r2d2"] = "r2d2/r2d2_WASF_N16.pt"
    path = shared_data / "weights" / of[name] if name in of else random_weights
    options = {"min_size": 80, "max_size": 100} if name == "r2d2" else {}
    given = {"weights": str(path), "device": "cpu", **options}
    extractor = load_plugin(LOCAL_FEATURES, name, given)
    frames = frames[1:3]  # the second with a mask
    alone = [extractor.extract(*frame) for frame in frames]
    assert min(len(found.scores) for found in alone) > 10
    together = extractor.extract_many(*map(list, zip(*frames, strict=True)))
    for a, b in zip(alone, together, strict=True):
        # scores within rounding of the threshold may differ
        distance, row = cKDTree(a.keypoints_px[:, :2]).query(b.keypoints_px[:, :2])
        near = distance < 0.01
        assert near.sum() >= 0.99 * max(len(a.scores), len(b.scores))
        np.testing.assert_allclose(a.scores[row[near]], b.scores[near], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(a.descriptors[row[near]], b.descriptors[near], atol=5e-3)
        assert a.num_masked == pytest.approx(b.num_masked, abs=2)
    # on a CPU each image runs alone: equal bytes
    for a, b in zip(alone, extract_all(extractor, frames, NAMES[1:3]), strict=True):
        assert a.keypoints_px.tobytes() == b.keypoints_px.tobytes()
        assert a.descriptors.tobytes() == b.descriptors.tobytes()


class Limited:
    """A plugin whose device has memory for a number of items; it returns them."""

    options = SimpleNamespace(device="cpu")
    name = "limited"

    def __init__(self, most: int) -> None:
        self.most = most
        self.seen: list[int] = []

    def extract(self, image: Any, mask: Any = None) -> Any:
        return self.extract_many([image], [mask])[0]

    def match(self, a: Any, b: Any) -> Any:
        return self.match_many(a, [b])[0]

    def extract_many(self, images: Any, masks: Any) -> Any:
        return self.match_many(masks, images)

    def match_many(self, _: Any, items: Sequence[Any]) -> Any:
        self.seen.append(len(items))
        if len(items) > self.most:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB.")
        return list(items)


@pytest.fixture
def eight_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "_limits", {})
    monkeypatch.setitem(devices.MOST_AT_ONCE, "cpu", 8)


def batched(plugin: Any, run: Any) -> list[str]:
    return in_batches(plugin, "match_many", run, NAMES, name=str)


def test_memory_that_runs_out_halves_the_batch(eight_at_once: None, frames: Any) -> None:
    plugin = Limited(most=2)
    for sizes in ([5, 2, 2, 1], [2, 2, 1]):  # the limit is remembered
        assert batched(plugin, lambda items: plugin.match_many(None, items)) == NAMES
        assert plugin.seen == sizes
        plugin.seen.clear()
    none = Limited(most=0)
    with pytest.raises(MeglocError, match=r"image 0\.jpg: not enough memory"):
        extract_all(none, frames, NAMES)
    with pytest.raises(TypeError) as failure:
        extract_all(Limited(None), frames, NAMES)
    assert failure.value.__notes__ == ["Limited failed on image 0.jpg"]
    image = ImageFeatures(np.zeros((3, 2), np.float32), np.zeros((3, 4), np.float32), 8, 8)
    with pytest.raises(MeglocError, match="pair 0, 1: not enough memory"):
        match_all(none, image, [image] * 3, ["pair 0, 1", "pair 0, 2", "pair 0, 3"])
    assert none.seen == [5, 2, 1, 2, 1]


def test_other_errors_are_not_retried(eight_at_once: None) -> None:
    def broken(_: Any) -> Any:
        raise RuntimeError("sizes do not agree")

    with pytest.raises(RuntimeError, match="sizes do not agree"):
        batched(Limited(9), broken)
    with pytest.raises(PluginError, match="match_many of Limited returned 0 results for 5 items"):
        batched(Limited(9), lambda _: [])
    with pytest.raises(TypeError, match="not iterable") as failure:  # not of the caller's code
        batched(Limited(9), lambda _: 5)
    assert failure.value.__notes__ == ["Limited failed on 0"]


class ManySift(RootSift):
    def __init__(self) -> None:
        super().__init__(RootSiftOptions(max_keypoints=300))
        self.seen: list[int] = []
        self.threads: set[int] = set()

    def extract_many(self, images: Any, masks: Any) -> list[LocalFeatures]:
        self.seen.append(len(images))
        self.threads.add(threading.get_ident())
        return [self.extract(*each) for each in zip(images, masks, strict=True)]


def test_one_thread_uses_the_gpu(
    world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = [world.mapping(), world.query()]
    images = sorted(world.map_poses)[:2]
    pairs = [ImagePair(query, image, 1.0) for query in world.query_poses for image in images]

    def run(output: Path, work: Work) -> ManySift:
        extractor, matcher = ManySift(), NearestNeighbours()
        extract_local_features(folders, extractor, output, work=work)
        query, mapping = (folder.with_features([output]) for folder in reversed(folders))
        how = TwoViewOptions()
        match_pairs(query, mapping, pairs, extractor.name, matcher, how, output, work=work)
        return extractor

    monkeypatch.setattr(devices, "_limits", {})
    monkeypatch.setattr(devices, "BATCH", 3)
    run(tmp_path / "here", Work())
    monkeypatch.setattr(
        devices, "on_gpu", lambda plugin: isinstance(plugin, RootSift | NearestNeighbours)
    )
    with ThreadPoolExecutor(2) as executor:
        there = run(tmp_path / "there", Work(executor))
    assert folder_bytes(tmp_path / "here") == folder_bytes(tmp_path / "there")
    assert there.seen == [3, 3]  # and the seventh image alone
    assert len(there.threads) == 1 and threading.get_ident() not in there.threads


def test_networks_without_a_device_use_that_of_the_run() -> None:
    placement = NetworkOptions(device="cuda:1", half_precision=True)
    plain = load_plugin(MATCHERS, "nn", {"max_ratio": 0.9}, placement)  # without these options
    assert plain.options.max_ratio == 0.9
    ranking = {"distance": {"name": "structure"}, "device": "cpu"}
    ranker = load_plugin(POSE_RANKERS, "perceptual", ranking, placement)
    assert (ranker.options.device, ranker.options.half_precision) == ("cpu", True)
    options = options_of_preset("classic", assignments={"device": "cuda:1", "precision": "half"})
    assert options.placement == placement
    (stage, *_) = wanted_stages([ExtractLocalFeatures], options)
    assert stage.placement == placement


def test_settings_depend_on_precision_not_on_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    stages = ExtractLocalFeatures, MatchQueries
    network = SimpleNamespace(options=SimpleNamespace(half_precision=False))
    for stage in stages:
        monkeypatch.setattr(stage, "plugins", lambda _: (network,))
    plain, here, half = (
        [stage(options_of_preset("megloc", assignments=changes)).settings() for stage in stages]
        for changes in ({}, {"device": "cpu"}, {"precision": "half"})
    )
    assert plain == here != half


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_device_without_a_gpu_is_refused() -> None:
    assert pick_device("auto") == pick_device("cpu") == torch.device("cpu")
    with pytest.raises(OptionError, match="device=cuda:0: this machine has no GPU"):
        pick_device("cuda:0")


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("CUDA error: out of memory", True),
        ("cuDNN error: CUDNN_STATUS_ALLOC_FAILED", True),
        ("[enforce fail at alloc_cpu.cpp] can't allocate memory: you tried to allocate", True),
        ("CUDA error: device-side assert triggered", False),
    ],
)
def test_out_of_memory_is_recognised(message: str, expected: bool) -> None:
    assert is_out_of_memory(RuntimeError(message)) == expected


def test_a_localizer_takes_device_and_precision(world: Any) -> None:
    opened = KaptureMap.open(world.root / "map", features_dirs=[world.features_dir])
    placed = Localizer(opened, preset="modern", device="cpu", precision="half").options
    assert placed.placement == NetworkOptions(device="cpu", half_precision=True)
    options = options_of_preset("classic", assignments={"device": "cpu"})
    with pytest.raises(OptionError, match="give the device and the precision in the options"):
        Localizer(opened, options=options, device="cuda")


class Declares(PipelineStage):
    name = "declares"
    uses = ("local_features.name", "mask_margin_px", "triangulation.two_view_tracks")

    def run(self, work: StageWork) -> Mapping[str, float]:
        return {}


def test_settings_are_the_declared_options() -> None:
    options = PipelineOptions(
        local_features=({"name": "rootsift", "options": {"max_keypoints": 5}}, {"name": "sift"})
    )
    assert Declares(options).settings() == {
        "local_features": [{"name": "rootsift"}, {"name": "sift"}],
        "mask_margin_px": 4.0,
        "triangulation": {"two_view_tracks": False},
    }


def test_a_new_matcher_changes_settings_of_matching_stages_only() -> None:
    changed = PipelineOptions(matching={"name": "nn", "options": {"max_ratio": 0.5}})
    same = [kind.name for kind in PIPELINE if isinstance(kind.name, str)]
    for kind in PIPELINE:
        before, after = kind(PipelineOptions()), kind(changed)
        if before.settings() != after.settings():
            same.remove(before.name)
    assert set(same) >= {"local_features", "global_features", LocalizeQueries.name, "map"}
    assert not {"mapping_matches", "query_matches"} & set(same)


def test_no_stage_reads_the_output_of_a_later_stage() -> None:
    for options in (PipelineOptions(), PipelineOptions(reranking={"by": "verified"})):
        written: list[str] = []
        stages = wanted_stages(PIPELINE, options)
        for at, stage in enumerate(stages):
            written += stage.writes
            later = {path for other in stages[at + 1 :] for path in other.writes}
            assert not set(stage.reads) & (later - set(written)), stage.name


def test_results_are_in_order() -> None:
    first_may_end = threading.Event()

    def work(value: int) -> int:
        if value == 0:
            assert first_may_end.wait(timeout=30)
        if value == 5:
            first_may_end.set()
        return value

    with ThreadPoolExecutor(3) as executor:
        assert list(ordered_map(work, range(20), executor, window=8)) == list(range(20))
        assert list(ordered_map(work, [], executor)) == []
    sift: Any = partial(pow, cv2.SIFT.create())  # as a plugin that creates it in __init__
    with (
        ProcessPoolExecutor(2) as pool,
        pytest.raises(
            PluginError, match=r"a plugin cannot be sent .*: cannot pickle 'cv2\.SIFT' obj"
        ),
    ):
        list(ordered_map(sift, [1], pool))
    # without an executor results are computed lazily
    done: list[int] = []
    results = ordered_map(lambda value: done.append(value) or value, [3, 1, 2])
    assert done == []
    assert next(iter(results)) == 3
    assert done == [3]
    assert list(results) == [1, 2]


def test_at_most_a_window_of_items_is_submitted() -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        for value in range(100):
            taken += 1
            yield value

    with ThreadPoolExecutor(2) as executor:
        results = ordered_map(int, items(), executor, window=5)
        for count, _ in enumerate(results, start=1):
            assert taken <= count + 5


def test_a_process_opens_a_folder_once(world: Any) -> None:
    folder = world.mapping()
    # a copy is made as in a process to which the folder is sent, by __reduce__
    assert copy(folder) is copy(folder)
    # a new folder is opened again and reads new features
    assert copy(world.mapping()) is not copy(folder)

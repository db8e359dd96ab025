"""The preset ``megloc`` with random weights in every official container: all stages, end to end."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from megloc_kapture.io.kapture import KaptureFolder
from tests.pipeline.runs import run_command

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from whole_preset import (  # noqa: E402
    WIRINGS,
    Wiring,
    add_weights,
    pair_by_covisibility,
    run,
)
from whole_preset_artefacts import artefacts, read_features  # noqa: E402
from whole_preset_scene import RANDOM_SCENE, Scene  # noqa: E402
from whole_preset_weights import Sizes, write_random_weights  # noqa: E402

pytestmark = pytest.mark.slow

SCENE = Scene(
    RANDOM_SCENE.world.model_copy(
        update={"num_places": 1, "day_queries": 2, "width": 192, "height": 144, "supersampling": 1}
    ),
    steps=2,
    beside=True,
)
MAP_IMAGES, QUERIES = 18, 2
# whitenings of full size are a gigabyte
SMALL = Sizes(clusters=4, whitened=32, hidden=8)
CHANGES = (
    "preprocessing.max_size_px=160",
    "local_features.superpoint.options.max_keypoints=150",
    "local_features.aslfeat.options.max_keypoints=150",
    "global_features.openibl.options.max_size_px=160",
    "global_features.delg.options.scales=[1.0]",
    "local_features.superpoint.matching.options.sinkhorn_iterations=20",
    "guided_pyramid.scales=[0.5]",
    "guided_pyramid.rotations_deg=[0]",
    "mapping_pairs.top_k=1",
    "mapping_pairs.poses.num_neighbours=2",
    "query_pairs.top_k=4",
    "reranking.keep=3",
)
STAGES = [
    *("import", "preprocess", "local_features", "global_features"),
    *("mapping_pairs", "mapping_matches", "mapping_rematching", "points", "map"),
    *("query_candidates", "query_matches", "query_pairs", "query_rematching"),
    *("localization", "refine_poses", "submission", "evaluation"),
]


def megloc(_: str, arguments: Sequence[str]) -> float:
    run_command(*arguments, "--quiet")
    return 0.0


def changed(*more: str) -> list[str]:
    return ["--executor", "inline", *(p for c in (*CHANGES, *more) for p in ("--set", c))]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_random_weights(tmp_path_factory.mktemp("made"), seed=0, sizes=SMALL)


@pytest.fixture(scope="module", autouse=True)
def added(made: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("weights")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MEGLOC_WEIGHTS", str(folder))
        add_weights(made, megloc)
        yield folder


@pytest.fixture(scope="module")
def workspace(added: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    wiring = Wiring("random", SCENE, WIRINGS["random"].options)
    return run(wiring, tmp_path_factory.mktemp("whole"), megloc, changed())


def test_kapture_reads_the_output_of_every_stage_and_network(workspace: Path) -> None:
    found = artefacts(workspace)
    assert list(dict.fromkeys(one.stage for one in found)) == STAGES
    assert sorted(p.stem for p in (workspace / "stages").glob("[!.]*.json")) == sorted(STAGES)
    images = tuple(workspace / "preprocessed" / part for part in ("mapping", "query"))
    features = read_features(workspace, images)
    assert {name for name in features if name.endswith(" vectors")} == {
        "netvlad-pitts30k vectors",
        "delg-r101-gldv2clean vectors",
        "apgem-resnet101-lm18-Landmarks_clean-0.25 vectors",
        "openibl vectors",
    }
    for name, rows in features.items():
        if name.endswith(" vectors"):
            assert rows == MAP_IMAGES + QUERIES, name
    for local_type in ("superpoint", "aslfeat"):
        assert features[f"{local_type} keypoints"] == features[f"{local_type} descriptors"] > 100
        before = read_features(workspace / "matches" / "mapping", images)
        after = read_features(workspace / "pyramid" / "mapping", images)
        assert after[f"{local_type}-pyramid matches"] >= before[f"{local_type} matches"] > 0
        after = read_features(workspace / "pyramid" / "query", images)
        assert after[f"{local_type}-pyramid keypoints"] > 0
    classes = list((workspace / "preprocessed" / "query" / "sensors" / "classes").rglob("*.png"))
    assert len(classes) == QUERIES
    # queries are undistorted and keep their depth
    before = KaptureFolder(workspace / "query").read()
    after = KaptureFolder(workspace / "preprocessed" / "query").read()
    for image in after.image_names():
        assert before.camera_of(image).model == "SIMPLE_RADIAL"
        assert after.camera_of(image).model in ("PINHOLE", "SIMPLE_PINHOLE")
    assert len(after.records_depth) == QUERIES
    report = json.loads((workspace / "map" / "reconstruction" / "refinement.json").read_text())
    assert report["points_before"] > report["points_after"] > 50
    assert pair_by_covisibility(workspace, megloc) > 0

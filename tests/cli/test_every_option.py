"""Every option of the pipeline changes what its test names, or is refused: none is ignored.

The options are those of the models: a new one fails here until it has a case.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args, get_origin

import numpy as np
import pytest
from corner import write_scene

from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.plugins import PluginChoice
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.values import Camera, Options, RigidTransform

pytestmark = pytest.mark.slow

FEW = "local_features.rootsift.options.max_keypoints=300"
TWO = ('local_features=["rootsift","sift"]', FEW)
STEREO = ("mvs.mode=depth", "mvs.max_size_px=96")
FUSED = (
    *TWO,
    'global_features=[{name="vlad"},{name="vlad",options={local_type="sift"}}]',
    "query_pairs.top_k=3",
)
# matches that are mostly wrong, and a RANSAC that does not look long: what it draws matters
HARD = ("verification=none", "matching.options.max_ratio=1.0", "localization.clusters.by=none")
HASTY = (*HARD, "localization.pose.min_iterations=1", "localization.pose.max_iterations=30")
LOOSE = ("matching.options.max_ratio=1.0", "query_verification.min_iterations=1")


@dataclass(frozen=True)
class Case:
    """One option with another value than its default.

    Parameters
    ----------
    value : as ``--set`` takes it.
    changes : what ``megloc eval`` then writes in another way, a path below the workspace.
    context : other options, without which it has nothing to act on.
    scene : a fixture of this module.
    refused : what ``megloc eval`` says instead of running.
    localize : what ``megloc localize`` says instead of running, of options that it uses; empty: its
        result changes.
    localize_value : for ``megloc localize``, where that takes another change.
    also : what has to be set with it.
    """

    value: str
    changes: str = "localized/"
    context: tuple[str, ...] = ()
    scene: str = "plain"
    refused: str = ""
    localize: str = ""
    localize_value: str = ""
    also: tuple[str, ...] = ()


OF_MAPS = "nothing here uses it"
# options of maps that are made: megloc localize refuses all of them
MAKING = ("map", "given_features", "triangulation", "lifting", "refinement", "mvs", "stages")
OF_FOLDERS = "are for folders of images"
PYRAMID = ("guided_pyramid.mode=all", "guided_pyramid.min_matches=200")
BY_POSES, BY_SEQUENCE = (f'mapping_pairs.by=["{by}"]' for by in ("poses", "sequence"))
CLUSTERED = ("localization.clusters={by='poses',radius=0.01}",)
ONE_CLUSTER = ("localization.clusters.max_clusters=1",)


NO_NETWORK = "no network is chosen that has it"

CASES: dict[str, Case] = {
    "device": Case('"cpu"', refused=NO_NETWORK, localize=NO_NETWORK),
    "precision": Case('"half"', refused=NO_NETWORK, localize=NO_NETWORK),
    "preprocessing.max_size_px": Case("240", "preprocessed/"),
    "preprocessing.upscale": Case("true", "preprocessed/", ("preprocessing.max_size_px=480",)),
    "preprocessing.multiple_of": Case("64", "preprocessed/", ("preprocessing.max_size_px=300",)),
    "preprocessing.undistort": Case("true", "preprocessed/", scene="distorted"),
    "preprocessing.blank_pixels": Case(
        "1.0", "preprocessed/", ("preprocessing.undistort=true",), scene="distorted"
    ),
    "preprocessing.masks.segmenter": Case(
        '"deeplabv3plus"', refused="the weights deeplabv3plus", localize="the weights deeplabv3plus"
    ),
    "preprocessing.masks.dynamic": Case(
        '["car"]', refused="no segmenter tells", localize="no segmenter tells"
    ),
    "preprocessing.masks.fixed": Case(
        '[{camera="cam",bottom_share=0.4}]', "preprocessed/", localize=OF_FOLDERS
    ),
    "preprocessing.masks.unchanging": Case(
        "true", refused="no unchanging region can be found", localize=OF_FOLDERS
    ),
    "preprocessing.masks.user_masks": Case(
        '"{masks}"', "preprocessed/", scene="plain", localize=OF_FOLDERS
    ),
    "local_features": Case('"sift"', "local_features/", localize="nothing in it is of sift"),
    "mask_margin_px": Case("60", "local_features/", scene="masked"),
    "global_features": Case(
        '[{name="vlad",options={num_clusters=4}}]', "global_features/", ("query_pairs.top_k=2",)
    ),
    "fusion.method": Case('"reciprocal_rank"', "pairs/", FUSED),
    "mapping_pairs.by": Case('["exhaustive"]', "pairs/mapping.txt"),
    "mapping_pairs.top_k": Case("2", "pairs/mapping.txt"),
    "mapping_pairs.poses.num_neighbours": Case("1", "pairs/mapping.txt", (BY_POSES,)),
    "mapping_pairs.poses.max_distance": Case("0.5", "pairs/mapping.txt", (BY_POSES,)),
    "mapping_pairs.poses.max_angle_deg": Case("2.0", "pairs/mapping.txt", (BY_POSES,)),
    "mapping_pairs.poses.min_overlap": Case(
        "0.5", context=(BY_POSES,), refused="comes with no model"
    ),
    "mapping_pairs.covisibility.top_k": Case("2", context=(BY_POSES,), refused="is not in"),
    "mapping_pairs.covisibility.min_shared_points": Case(
        "2", context=(BY_POSES,), refused="is not in"
    ),
    "mapping_pairs.sequence.window": Case("1", "pairs/mapping.txt", (BY_SEQUENCE,)),
    "mapping_pairs.sequence.loop": Case(
        "true", "pairs/mapping.txt", (BY_SEQUENCE, "mapping_pairs.sequence.window=1")
    ),
    "query_pairs.by": Case('"exhaustive"', "pairs/query.txt"),
    "query_pairs.top_k": Case("2", "pairs/query.txt"),
    "reranking.by": Case('"verified"', "pairs/query.txt", also=("reranking.keep=3",)),
    "reranking.local_type": Case(
        '"rootsift"', "pairs/query.txt", (*TWO, "reranking.by=verified", "reranking.keep=2")
    ),
    "reranking.keep": Case("2", "pairs/query.txt", ("reranking.by=coverage",)),
    "matching": Case('{name="nn",options={max_ratio=0.6}}', "matches/"),
    "verification": Case('"none"', "matches/"),
    "mapping_verification.max_error_px": Case("0.3", "matches/mapping"),
    "mapping_verification.min_matches": Case("150", "matches/mapping"),
    "query_verification.max_error_px": Case("0.3", "matches/query"),
    "query_verification.min_matches": Case("150", "matches/query"),
    "query_verification.max_iterations": Case("1", "matches/query", LOOSE),
    "query_verification.min_iterations": Case(
        "1",
        "matches/query",
        ("matching.options.max_ratio=1.0", "query_verification.confidence=0.01"),
    ),
    "query_verification.confidence": Case("0.01", "matches/query", LOOSE),
    "query_verification.seed": Case(
        "7", "matches/query", (*LOOSE, "query_verification.max_iterations=1")
    ),
    "guided_pyramid.mode": Case('"all"', "pyramid/", also=("guided_pyramid.min_matches=200",)),
    "guided_pyramid.min_matches": Case("200", "pyramid/", PYRAMID[:1]),
    "guided_pyramid.count": Case('"matches"', "pyramid/", (*PYRAMID, LOOSE[0])),
    "guided_pyramid.scales": Case("[1.0,2.0]", "pyramid/", PYRAMID),
    "guided_pyramid.rotations_deg": Case("[0]", "pyramid/", PYRAMID),
    "guided_pyramid.max_side_px": Case("500", "pyramid/", PYRAMID),
    "map": Case('"lift"', "map/", scene="with_depth"),
    "given_features": Case('"rootsift"', refused="takes no given model"),
    "triangulation.max_reprojection_error_px": Case("0.2", "map/"),
    "triangulation.min_angle_deg": Case("8.0", "map/"),
    "triangulation.two_view_tracks": Case("true", "map/"),
    "lifting.max_jump": Case("0.00001", "map/", ("map=lift",), scene="with_depth"),
    "refinement.depth.max_sigmas": Case("0.01", "map/", scene="with_depth"),
    "refinement.depth.noise": Case(
        "[0.0000001,0.0,0.0]",
        "map/",
        ("refinement.depth.keypoint_noise_px=0.001",),
        scene="with_depth",
    ),
    "refinement.depth.keypoint_noise_px": Case(
        "0.001", "map/", ("refinement.depth.noise=[0.0000001,0.0,0.0]",), scene="with_depth"
    ),
    "refinement.depth.window_px": Case(
        "31", "map/", ("refinement.depth.max_sigmas=0.1",), scene="with_depth"
    ),
    "refinement.uncertainty.max_robust_sigmas": Case("0.5", "map/"),
    "mvs.mode": Case("points", "map/", STEREO),
    "mvs.estimator": Case('{name="sweep",options={passes=1}}', "map/", STEREO),
    "mvs.num_sources": Case("1", "map/", STEREO),
    "mvs.max_size_px": Case("80", "map/", STEREO),
    "mvs.agreement.min_views": Case("2", "map/", STEREO),
    "mvs.agreement.max_error_px": Case("0.1", "map/", STEREO),
    "mvs.agreement.max_relative_error": Case("0.0005", "map/", STEREO),
    "mvs.agreement.max_relative_sigma": Case("0.003", "map/", STEREO),
    "localization.clusters.by": Case(
        '"poses"', context=ONE_CLUSTER, also=("localization.clusters.radius=0.01",)
    ),
    "localization.clusters.radius": Case(
        "0.01", context=("localization.clusters={by='poses',radius=100.0,max_clusters=1}",)
    ),
    "localization.clusters.min_shared_points": Case("100000", context=ONE_CLUSTER),
    "localization.clusters.max_clusters": Case("1", context=CLUSTERED),
    "localization.rank": Case('"reprojection"', context=CLUSTERED),
    "localization.pose.max_error_px": Case("0.5"),
    "localization.pose.min_inliers": Case("100000"),
    "localization.pose.max_center_deviation": Case("0.0000001"),
    "localization.pose.map_noise": Case("0.0"),
    "localization.pose.min_iterations": Case(
        "1", context=(*HARD, "localization.pose.confidence=0.0001")
    ),
    "localization.pose.max_iterations": Case("1", context=HASTY),
    "localization.pose.confidence": Case("0.0001", context=HASTY),
    "localization.pose.seed": Case("9", context=HASTY),
    "localization.min_confidence": Case("1.0"),
    "localization.sure_confidence": Case("0.5"),
    "localization.rigs": Case("true", scene="with_rig"),
    "localization.fallback": Case('"retrieval"', context=("localization.pose.min_inliers=100000",)),
    "pose_refinement.by": Case(
        "[]",
        scene="with_depth",
        localize_value='["icp"]',  # this dataset's file has icp
    ),
    "stages": Case("{nothing={}}", refused="no plugin 'nothing' in megloc_kapture.stages"),
    "pose_refinement.max_references": Case(
        "1", context=('pose_refinement.by=["rendering"]',), scene="with_depth"
    ),
}


def leaves(model: type[Options], above: str = "") -> Iterator[str]:
    """Paths of all options of a model, of models within it too; a list of plugins is one."""
    for name, field in model.model_fields.items():
        kinds = () if get_origin(field.annotation) is tuple else get_args(field.annotation)
        inner = [kind for kind in (field.annotation, *kinds) if is_model(kind)]
        if inner:
            yield from leaves(inner[0], f"{above}{name}.")
        else:
            yield above + name


def is_model(kind: Any) -> bool:
    return (
        isinstance(kind, type) and issubclass(kind, Options) and not issubclass(kind, PluginChoice)
    )


def test_every_option_has_a_case() -> None:
    assert sorted(leaves(PipelineOptions)) == sorted(CASES)


# ------------------------------------------------------------------ scenes


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return without_truth(tmp_path_factory.mktemp("plain"))


@pytest.fixture(scope="module")
def with_depth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return without_truth(tmp_path_factory.mktemp("with_depth"), with_depth=True)


def without_truth(root: Path, *, with_depth: bool = False) -> Path:
    write_scene(root, with_depth=with_depth)
    shutil.rmtree(root / "query_gt")
    return root


@pytest.fixture(scope="module")
def masked(plain: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a masked strip in every image."""
    root = tmp_path_factory.mktemp("masked") / "scene"
    shutil.copytree(plain, root)
    mask = np.full((300, 400), 255, np.uint8)
    mask[:, 180:200] = 0
    for part in ("mapping", "query"):
        for image in KaptureFolder(root / part).read().image_names():
            write_image(root / part / "sensors" / "masks" / f"{image}.png", mask)
    return root


@pytest.fixture(scope="module")
def distorted(plain: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Described as if a lens had bent the images a little."""
    root = tmp_path_factory.mktemp("distorted") / "scene"
    shutil.copytree(plain, root)
    camera = Camera("SIMPLE_RADIAL", 400, 300, (301.0, 200.0, 150.0, -0.02))
    for part in ("mapping", "query"):
        data = KaptureFolder(root / part).read()
        write_sensors(root / part, replace(data, sensors={"cam": Sensor.from_camera(camera)}))
    return root


@pytest.fixture(scope="module")
def with_rig(plain: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Queries of a rig of two cameras, whose calibration is somewhat off: together is not alone."""
    root = tmp_path_factory.mktemp("with_rig") / "scene"
    shutil.copytree(plain, root)
    write_scene(root.parent / "truth")
    truth = KaptureFolder(root.parent / "truth" / "query_gt").read()
    names, poses = truth.image_names(), truth.poses()
    data = KaptureData(sensors=dict.fromkeys(("left", "right"), truth.sensors["cam"]))
    right_from_left = poses[names[1]] @ poses[names[0]].inverse()
    off = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.01, 0.0, 0.0))
    data.rigs["rig"] = {"left": RigidTransform.identity(), "right": off @ right_from_left}
    moments = ((1, "left"), (1, "right"), (2, "left"), (3, "right"))
    data.records_camera = dict(zip(moments, names, strict=True))
    write_sensors(root / "query", data)
    return root


# ------------------------------------------------------------------ runs

Base = Callable[[str, tuple[str, ...]], Path]


def flags(assignments: tuple[str, ...]) -> list[str]:
    return [flag for one in assignments for flag in ("--set", one)]


def written(root: Path) -> dict[str, bytes]:
    """What stages wrote, without what says when and with which options."""
    found = {}
    for path in sorted(root.rglob("*")):
        relative = str(path.relative_to(root))
        other = relative.startswith(("stages/", "evaluation/", "timing", "."))
        if path.is_file() and not other and path.suffix != ".json":
            found[relative] = path.read_bytes()
    return found


@pytest.fixture(scope="module")
def base(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Base:
    """Workspaces of finished runs by scene and context, each made once."""
    from megloc_kapture.cli.main import main

    made: dict[tuple[str, tuple[str, ...]], Path] = {}

    def run(scene: str, context: tuple[str, ...]) -> Path:
        if (scene, context) not in made:
            root = request.getfixturevalue(scene)
            workspace = tmp_path_factory.mktemp("base") / "workspace"
            places = ["eval", "kapture", "--root", str(root), "-w", str(workspace)]
            with pytest.raises(SystemExit) as end:
                main([*places, "--executor", "inline", "-q", *flags(context)])
            assert end.value.code == 0
            made[scene, context] = workspace
        return made[scene, context]

    return run


def context_of(case: Case) -> tuple[str, ...]:
    named = any(one.startswith("local_features") for one in case.context)
    return case.context if named else (FEW, *case.context)


@pytest.fixture(scope="module")
def masks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a mask of one image."""
    folder = tmp_path_factory.mktemp("masks")
    mask = np.full((300, 400), 255, np.uint8)
    mask[100:200] = 0
    for image in ("0000.jpg", "0001.jpg"):  # of the map and of the queries
        write_image(folder / f"{image}.png", mask)
    return folder


@pytest.mark.parametrize("option", CASES)
def test_eval(
    option: str, megloc: Any, base: Base, masks: Path, tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:  # fmt: skip
    case, workspace = CASES[option], tmp_path / "workspace"
    root = request.getfixturevalue(case.scene)
    changed = f"{option}={case.value.replace('{masks}', str(masks))}"
    arguments = ["eval", "kapture", "--root", root, "--executor", "inline", "-q", "-w", workspace]
    arguments += flags((*context_of(case), *case.also, changed))
    if case.refused:
        megloc(*arguments).refused(case.refused)
        return
    before = base(case.scene, context_of(case))
    shutil.copytree(before, workspace, symlinks=True)
    done = megloc(*arguments)
    assert done.status == 0, done
    old, new = written(before), written(workspace)
    different = {path for path in old.keys() | new.keys() if old.get(path) != new.get(path)}
    assert any(path.startswith(case.changes) for path in different), sorted(different)[:5]


@pytest.mark.parametrize("option", CASES)
def test_localize(
    option: str, megloc: Any, base: Base, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    case = CASES[option]
    scene = request.getfixturevalue(case.scene)
    changed = f"{option}={case.localize_value or case.value}"
    refused = OF_MAPS if option.startswith(MAKING) else case.localize
    if refused:
        arguments = ["localize", "-i", base("plain", (FEW,)) / "map", "--query", scene / "query"]
        megloc(*arguments, "-o", tmp_path / "new", "--set", changed).refused(refused)
        return
    workspace = base(case.scene, context_of(case))
    arguments = ["localize", "-i", workspace / "map", "--query", scene / "query", "-q"]
    results = []
    for name, more in (("old", ()), ("new", (*case.also, changed))):
        done = megloc(*arguments, "-o", tmp_path / name, *flags((*context_of(case), *more)))
        assert done.status == 0, done
        results.append(written(tmp_path / name))
    assert results[0] != results[1]

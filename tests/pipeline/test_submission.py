"""What is handed in: names, order, frames, rows, the rig, and the provenance beside it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import kapture
import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.evaluation.pose_files import read_mlad_file, read_pose_file
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.dataset_tables import (
    ImageGroup,
    Protocol,
    RelocalizationPair,
    SimilarityTransform,
    World,
    write_groups,
    write_names,
    write_protocol,
    write_relocalization,
    write_world,
)
from megloc_kapture.io.files import write_json_model
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.io.tables import write_status
from megloc_kapture.pipeline.datasets import DatasetChoice
from megloc_kapture.pipeline.evaluation_plan import Run
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.submission import (
    check_dataset,
    workspace_provenance,
    write_submission,
)
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.values import Camera, LocalizationResult, RigidTransform
from tests.pipeline.runs import manifest

CAMERA = Sensor.from_camera(Camera("PINHOLE", 640, 480, (500, 500, 320, 240)))
SIDES = ("left", "rear", "right")
# the origin of 4Seasons' frames, and a scale that some maps have
FAR = SimilarityTransform(
    quat_wxyz=(0.5, 0.5, -0.5, 0.5), translation=(4.1e6, 8.5e5, 4.8e6), scale=1.25
)


def random_poses(number: int, seed: int = 0) -> list[RigidTransform]:
    turns = Rotation.random(number, random_state=seed).as_matrix()
    shifts = np.random.default_rng(seed).normal(size=(number, 3)) * 20
    return [RigidTransform.from_matrix(r, t) for r, t in zip(turns, shifts, strict=True)]


def matrix(pose: RigidTransform) -> np.ndarray:
    w, x, y, z = pose.quat_wxyz
    whole = np.eye(4)
    whole[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    whole[:3, 3] = pose.translation
    return whole


class Dataset:
    """An import with a rig of three cameras at four moments, and a result for it."""

    def __init__(self, root: Path) -> None:
        self.root, self.tables, self.result = root, root / "megloc", root / "localized"
        offsets = random_poses(3, seed=7)
        self.rig = dict(zip(SIDES, offsets, strict=True))
        self.cars = dict(zip((10, 20, 30, 40), random_poses(4), strict=True))
        self.query = KaptureData(
            sensors=dict.fromkeys(SIDES, CAMERA),
            rigs={"car": self.rig},
            records_camera={
                (time, side): f"{'night' if time > 20 else 'dawn'}/{side}/{time}.jpg"
                for time in self.cars
                for side in SIDES
            },
        )
        write_sensors(root / "query", self.query)
        write_protocol(self.tables, Protocol(dataset="robotcar"))
        self.groups = {
            image: ImageGroup(scored="/rear/" in image) for image in self.query.image_names()
        }
        write_groups(self.tables, self.groups)
        self.names = {
            f"{'night' if time > 20 else 'dawn'}/rear/{time}.jpg": f"rear/{time}.png"
            for time in (40, 10, 30, 20)
        }

    def true_pose(self, image: str) -> RigidTransform:
        time, side = self.query.record_of(image)
        return self.rig[side] @ self.cars[time]

    def localize(self, images: list[str], statuses: Mapping[str, Mapping[str, Any]]) -> None:
        poses = {self.query.record_of(image): self.true_pose(image) for image in images}
        write_sensors(self.result, replace(self.query, rigs={}, trajectories=poses))
        rows = [LocalizationResult(name=image, **statuses.get(image, {})) for image in images]
        write_status(self.result / "status.csv", rows)


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return Dataset(tmp_path / "workspace")


FAILED = {"reason": "no map image matches"}
NONE = {"fallbacks": 0, "from_rig": 0, "dummies": 0, "doubtful": 0}


def submit(dataset: Dataset, place: Path, **options: Any) -> tuple[dict[str, int], dict[str, Any]]:
    counts = write_submission(
        dataset.result,
        place,
        tables=dataset.tables,
        provenance={"dataset": "robotcar", "preset": "classic", "options": {"a": 1}},
        **options,
    )
    return counts, json.loads(place.with_name(f"{place.name}.json").read_text())


def test_scored_images_by_the_rule(dataset: Dataset, tmp_path: Path) -> None:
    dataset.localize(["dawn/left/10.jpg", "dawn/rear/10.jpg", "night/rear/40.jpg"], {})
    counts, beside = submit(dataset, tmp_path / "poses.txt")
    assert list(read_pose_file(tmp_path / "poses.txt")) == ["dawn/rear/10.jpg", "night/rear/40.jpg"]
    assert counts == NONE | {"queries": 12, "scored": 4, "poses": 2, "missing": 2}
    assert beside["counts"] == counts
    assert beside["missing"] == ["dawn/rear/20.jpg", "night/rear/30.jpg"]


def test_names_with_white_space_have_no_row(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    images = ["a b.jpg", "c d/e.jpg", "f.jpg"]
    records = {(time, "rear"): image for time, image in enumerate(images)}
    poses = dict(zip(records, random_poses(3), strict=True))
    data = KaptureData({"rear": CAMERA}, {}, poses, records)
    write_sensors(tmp_path / "localized", data)
    place = tmp_path / "poses.txt"
    counts = write_submission(tmp_path / "localized", place, tables=None, provenance={})
    assert list(read_pose_file(place)) == ["f.jpg"]
    assert (counts["poses"], counts["missing"]) == (1, 2)
    assert "2 images are left out" in caplog.text and "'a b.jpg'" in caplog.text
    # by its last part the second can be called
    write_protocol(tmp_path / "megloc", Protocol(pose_file_names="basename"))
    counts = write_submission(
        tmp_path / "localized", place, tables=tmp_path / "megloc", provenance={}
    )
    assert list(read_pose_file(place)) == ["e.jpg", "f.jpg"] and counts["missing"] == 1


def test_doubtful_are_those_that_the_file_lacks(dataset: Dataset, tmp_path: Path) -> None:
    doubted = {**FAILED, "confidence": 0.3}
    guessed = {**doubted, "fallback": "retrieval"}
    dataset.localize(["dawn/rear/10.jpg", "dawn/rear/20.jpg"], {})
    # of those without a pose the first is not scored, and the last had none at all
    statuses = {
        "dawn/rear/20.jpg": guessed,
        "dawn/left/10.jpg": doubted,
        "night/rear/30.jpg": doubted,
        "night/rear/40.jpg": FAILED,
    }
    rows = [LocalizationResult(name=image, **status) for image, status in statuses.items()]
    write_status(dataset.result / "status.csv", rows)
    counts, _ = submit(dataset, tmp_path / "poses.txt")
    assert (counts["poses"], counts["missing"], counts["fallbacks"]) == (2, 2, 1)
    assert counts["doubtful"] == 1


def test_the_list_names_and_orders(dataset: Dataset, tmp_path: Path) -> None:
    write_names(dataset.tables, dataset.names)
    dataset.localize(dataset.query.image_names(), {})
    counts, _ = submit(dataset, tmp_path / "poses.txt")
    found = read_pose_file(tmp_path / "poses.txt")
    assert list(found) == ["rear/40.png", "rear/10.png", "rear/30.png", "rear/20.png"]
    assert found["rear/30.png"] == dataset.true_pose("night/rear/30.jpg")
    assert counts["poses"] == counts["scored"] == 4


def test_ltvl_poses_are_kaptures_own(dataset: Dataset, tmp_path: Path) -> None:
    dataset.localize(["dawn/rear/10.jpg"], {})
    submit(dataset, tmp_path / "poses.txt")
    name, *numbers = (tmp_path / "poses.txt").read_text().split()
    stored = KaptureFolder(dataset.result).read().poses()[name]
    theirs = kapture.PoseTransform([float(v) for v in numbers[:4]], [float(v) for v in numbers[4:]])
    np.testing.assert_allclose(theirs.inverse().t_raw, stored.center(), atol=1e-9)


def test_poses_leave_in_the_official_frame(dataset: Dataset, tmp_path: Path) -> None:
    write_world(dataset.tables, World(official_from_local=FAR))
    dataset.localize(["dawn/rear/10.jpg"], {})
    submit(dataset, tmp_path / "poses.txt")
    pose = matrix(read_pose_file(tmp_path / "poses.txt")["dawn/rear/10.jpg"])
    points = np.random.default_rng(0).normal(size=(5, 3)) * 10
    local = matrix(dataset.true_pose("dawn/rear/10.jpg"))
    turn = Rotation.from_quat(np.roll(FAR.quat_wxyz, -1))
    official = 1.25 * turn.apply(points) + FAR.translation
    np.testing.assert_allclose(
        official @ pose[:3, :3].T + pose[:3, 3],
        1.25 * (points @ local[:3, :3].T + local[:3, 3]),
        atol=1e-8,
    )


def test_without_tables_every_image_counts(dataset: Dataset, tmp_path: Path) -> None:
    dataset.localize(["dawn/left/10.jpg"], {})
    counts = write_submission(dataset.result, tmp_path / "poses.txt", tables=None, provenance={})
    assert (counts["queries"], counts["scored"], counts["poses"]) == (12, 12, 1)


def test_what_cannot_be_handed_in_is_refused(dataset: Dataset, tmp_path: Path) -> None:
    place = tmp_path / "poses.txt"
    dataset.localize(dataset.query.image_names(), {})
    write_sensors(dataset.root / "query", replace(dataset.query, rigs={}))
    with pytest.raises(DataError, match="poses cannot be derived from the rig"):
        submit(dataset, place, from_rig=True)
    write_protocol(dataset.tables, Protocol(dataset="robotcar", pose_file_names="basename"))
    write_groups(dataset.tables, {})
    with pytest.raises(DataError, match="would both be called '10.jpg'"):
        submit(dataset, place)
    stranger = replace(dataset.query, records_camera={(1, "left"): "other.jpg"})
    write_sensors(dataset.root / "query", stranger)
    with pytest.raises(DataError, match="is not among the queries of .*query"):
        submit(dataset, place)
    assert not place.exists()


def test_poses_of_the_rig_only_when_asked(dataset: Dataset, tmp_path: Path) -> None:
    statuses = {
        "dawn/left/10.jpg": {"num_inliers": 30},
        "dawn/right/10.jpg": {"num_inliers": 90},
        "dawn/rear/20.jpg": {**FAILED, "fallback": "retrieval"},
        "dawn/left/20.jpg": {"num_inliers": 20},
        "night/left/30.jpg": {**FAILED, "fallback": "retrieval"},
    }
    dataset.localize(list(statuses), statuses)
    counts, _ = submit(dataset, tmp_path / "without.txt")
    assert list(read_pose_file(tmp_path / "without.txt")) == ["dawn/rear/20.jpg"]
    assert (counts["poses"], counts["fallbacks"], counts["from_rig"]) == (1, 1, 0)
    counts, beside = submit(dataset, tmp_path / "with.txt", from_rig=True)
    found = read_pose_file(tmp_path / "with.txt")
    # a guess gives nothing to others, and gives way to a pose of the rig
    assert list(found) == ["dawn/rear/10.jpg", "dawn/rear/20.jpg"]
    assert (counts["poses"], counts["fallbacks"], counts["from_rig"]) == (2, 0, 2)
    for image, pose in found.items():
        np.testing.assert_allclose(matrix(pose), matrix(dataset.true_pose(image)), atol=1e-9)
    assert beside["counts"]["from_rig"] == 2
    # one that came from the rig before is counted
    dataset.localize(["dawn/rear/10.jpg"], {"dawn/rear/10.jpg": {**FAILED, "fallback": "rig"}})
    counts, _ = submit(dataset, tmp_path / "poses.txt")
    assert (counts["poses"], counts["fallbacks"], counts["from_rig"]) == (1, 0, 1)


class Drives:
    """A map and queries of 4Seasons, and pairs of them in two relocalization files."""

    def __init__(self, root: Path, world: World) -> None:
        self.root, self.tables, self.result = root, root / "megloc", root / "localized"
        start = 1602074877390449152
        poses = random_poses(9)
        stamps = [start + 33_333_333 * i for i in range(9)]

        def drive(folder: str, images: slice, posed: slice) -> KaptureData:
            at = zip(stamps[posed], poses[posed], strict=True)
            return KaptureData(
                sensors={"cam0": CAMERA},
                trajectories={(t, "cam0"): pose for t, pose in at},
                records_camera={(t, "cam0"): f"{folder}/cam0/{t}.png" for t in stamps[images]},
            )

        self.mapping = drive("ref", slice(5), slice(4))
        self.localized = drive("test", slice(5, None), slice(5, 8))
        write_sensors(root / "mapping", self.mapping)
        write_sensors(root / "query", replace(self.localized, trajectories={}))
        write_sensors(self.result, self.localized)
        write_protocol(self.tables, Protocol(dataset="4seasons", pose_file="mlad"))
        write_world(self.tables, world)
        pairs = [(3, 7), (0, 5), (1, 6), (2, 8)]
        self.pairs = [(stamps[r], stamps[q]) for r, q in pairs]
        self.rows = [
            RelocalizationPair("a_to_b.txt", f"ref/cam0/{r}.png", f"test/cam0/{q}.png")
            for r, q in self.pairs
        ]
        self.unposed = RelocalizationPair(
            "sub/b.txt", f"ref/cam0/{stamps[4]}.png", f"test/cam0/{stamps[5]}.png"
        )
        write_relocalization(self.tables, [*self.rows, self.unposed])


@pytest.mark.parametrize("far", [False, True])
def test_mlad_files_are_those_of_kaptures_own_exporter(tmp_path: Path, far: bool) -> None:
    from tools.kapture_export_4seasons_pairs import export_4seasons_pairfile

    origin = SimilarityTransform(quat_wxyz=FAR.quat_wxyz, translation=FAR.translation)
    drives = Drives(tmp_path / "workspace", World(official_from_local=origin) if far else World())
    both = KaptureData(
        sensors=drives.mapping.sensors,
        rigs={"car": {"cam0": RigidTransform.identity()}},  # it asks for rigs
        trajectories=drives.mapping.trajectories | drives.localized.trajectories,
        records_camera=drives.mapping.records_camera | drives.localized.records_camera,
    )
    write_sensors(tmp_path / "both", both)
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("".join(f"{r} {q}\n" for r, q in drives.pairs))
    export_4seasons_pairfile(
        str(tmp_path / "both"), str(pairs), str(tmp_path / "theirs.txt"), heal_timestamps=False
    )
    place = tmp_path / "submission"
    counts = write_submission(drives.result, place, tables=drives.tables, provenance={})
    ours = np.loadtxt(place / "a_to_b.txt")
    theirs = np.loadtxt(tmp_path / "theirs.txt")
    assert ours.shape == theirs.shape == (4, 9)
    np.testing.assert_array_equal(ours[:, :2], theirs[:, :2])
    np.testing.assert_allclose(ours[:, 2:5], theirs[:, 2:5], atol=1e-9)
    found, expected = (Rotation.from_quat(rows[:, 5:]) for rows in (ours, theirs))
    assert (found * expected.inv()).magnitude().max() < 1e-12
    expected = {"queries": 4, "scored": 5, "poses": 3, "missing": 2, "dummies": 2}
    assert counts == NONE | expected


def test_mlad_rows_without_a_pose_are_dummies_by_name(tmp_path: Path) -> None:
    drives = Drives(tmp_path / "workspace", World(official_from_local=FAR))
    place = tmp_path / "out" / "submission"
    write_submission(drives.result, place, tables=drives.tables, provenance={})
    rows = read_mlad_file(place / "a_to_b.txt")
    assert [(row.reference, row.query) for row in rows] == drives.pairs
    last = place / "a_to_b.txt"
    assert last.read_text().splitlines()[3].split(" ", 2)[2] == "0.0 0.0 0.0 0.0 0.0 0.0 1.0"
    assert (place / "sub" / "b.txt").read_text().endswith("0.0 0.0 0.0 0.0 0.0 0.0 1.0\n")
    beside = json.loads((tmp_path / "out" / "submission.json").read_text())
    assert beside["dummies"] == [
        f"a_to_b.txt: {drives.rows[3].reference} {drives.rows[3].query}",
        f"sub/b.txt: {drives.unposed.reference} {drives.unposed.query}",
    ]
    assert sorted(beside["files"]) == ["a_to_b.txt", "sub/b.txt"]
    # lengths are the official ones
    first = rows[1].query_from_reference
    query, reference = drives.localized.poses(), drives.mapping.poses()
    relative = matrix(query[drives.rows[1].query]) @ np.linalg.inv(
        matrix(reference[drives.rows[1].reference])
    )
    assert first is not None
    np.testing.assert_allclose(first.translation, 1.25 * relative[:3, 3], atol=1e-9)
    write_relocalization(drives.tables, [])
    with pytest.raises(DataError, match=r"relocalization\.csv: no pairs"):
        write_submission(drives.result, tmp_path / "s", tables=drives.tables, provenance={})


def test_provenance_says_where_it_comes_from_and_when_nothing(
    dataset: Dataset, tmp_path: Path
) -> None:
    dataset.localize(["dawn/rear/10.jpg"], {})
    write_json_model(dataset.root / "stages" / "import.json", manifest("import"))
    place = tmp_path / "poses.txt"
    _, beside = submit(dataset, place)
    assert beside["dataset_fingerprint"] == "print of import"
    assert beside["weights"] == {}
    assert beside["dataset"] == "robotcar" and beside["preset"] == "classic"
    assert beside["options"] == {"a": 1} and "megloc-kapture" in beside["versions"]
    assert beside["files"] == {"poses.txt": hashlib.sha256(place.read_bytes()).hexdigest()}
    text = place.with_name("poses.txt.json").read_text()
    assert "2024" not in text and "1.5" not in text
    submit(dataset, tmp_path / "again" / "poses.txt")
    assert (tmp_path / "again" / "poses.txt").read_bytes() == place.read_bytes()
    assert (tmp_path / "again" / "poses.txt.json").read_text() == text


def test_options_of_a_workspace_are_told_only_where_they_are_the_results(tmp_path: Path) -> None:
    stages, result = tmp_path / "stages", tmp_path / "localized"
    assert workspace_provenance(result) == {}
    done = manifest("localization", outputs=("localized", "timing.csv"))
    write_json_model(stages / "localization.json", done)
    assert workspace_provenance(result) == {"localization_fingerprint": "print of localization"}
    assert workspace_provenance(tmp_path / "other") == {}
    options = {"dataset": "kapture", "preset": "classic", "options": {"map": "lift"}}
    for read in ("print of localization", "an older one"):
        handed_in = manifest("submission", options=options, inputs={"localization": read})
        write_json_model(stages / "submission.json", handed_in)
        told = workspace_provenance(result)
        own = {"preset": "classic", "options": {"map": "lift"}} if read.startswith("print") else {}
        assert told == {"localization_fingerprint": "print of localization"} | own


def test_weights_are_those_of_the_stages_that_a_result_is_made_of(
    dataset: Dataset, tmp_path: Path
) -> None:
    dataset.localize(["dawn/rear/10.jpg"], {})
    stages = dataset.result.parent / "stages"
    for one in (
        manifest("local_features", options={"weights": {"superpoint.pth": "ab"}}),
        manifest("matches", inputs={"local_features": "print of local_features"}),
        manifest("global_features", options={"weights": {"netvlad.mat": "cd"}}),
        # of another run, whose features are not there any more
        manifest("ranking", options={"weights": {"lpips.pth": "ef"}}),
        manifest(
            "pose_refinement",
            options={"weights": {"field.pth": "01"}},
            inputs={"matches": "print of matches", "global_features": "an older one"},
            outputs=(dataset.result.name,),
        ),
    ):
        write_json_model(stages / f"{one.stage}.json", one)
    _, beside = submit(dataset, tmp_path / "poses.txt")
    assert beside["weights"] == {"field.pth": "01", "superpoint.pth": "ab"}


@pytest.mark.parametrize(
    ("asked", "written", "words"),
    [
        ("aachen", "aachen", None),
        ("synthetic-aachen", "aachen", None),
        ("aachen", "synthetic-aachen", None),
        ("kapture", "kapture", None),
        ("synthetic", "kapture", None),
        ("kapture", "synthetic", None),
        ("kapture", "my-own-scene", None),
        (
            "aachen",
            "robotcar",
            r"aachen was requested, but .*protocol\.json is for dataset robotcar",
        ),
        ("aachen", "kapture", "of dataset kapture"),
        ("kapture", "aachen", "of dataset aachen"),
        ("synthetic", "synthetic-inloc", "of dataset synthetic-inloc"),
        ("aahcen", "aachen", "unknown dataset 'aahcen'; did you mean 'aachen'. known: kapture, "),
    ],
)
def test_datasets_that_go_together(
    asked: str, written: str, words: str | None, tmp_path: Path
) -> None:
    with nullcontext() if words is None else pytest.raises(OptionError, match=words):
        check_dataset(asked, Protocol(dataset=written), tables=tmp_path)


def test_rules_that_are_nowhere() -> None:
    check_dataset("kapture", Protocol(), tables=None)
    with pytest.raises(OptionError, match="rules of aachen are in the megloc/ folder"):
        check_dataset("aachen", Protocol(), tables=None)


@pytest.mark.parametrize(
    ("name", "stem"),
    [
        ("aachen", "Aachen_v1_1"),
        ("robotcar", "RobotCar"),
        ("inloc", "InLoc"),
        ("4seasons", "4Seasons"),
        ("kapture", "kapture"),
        # what no server takes says so
        ("synthetic", "synthetic"),
        ("synthetic-aachen", "synthetic-aachen"),
        ("synthetic-4seasons", "synthetic-4seasons"),
    ],
)
def test_a_run_calls_its_pose_file_as_the_server_does(name: str, stem: str, tmp_path: Path) -> None:
    rules = protocol_of(name.removeprefix("synthetic-") if name != "synthetic" else name)
    write_protocol(tmp_path / "megloc", rules)
    run = Run(DatasetChoice(name, None), "classic", PipelineOptions())
    end = "" if rules.pose_file == "mlad" else ".txt"
    expected = tmp_path / "submissions" / f"{stem}_eval_megloc-classic{end}"
    assert run.submission_below(tmp_path, tmp_path / "megloc") == expected


def test_label_and_pose_file_name_other_features_than_the_presets(
    tmp_path: Path,
) -> None:
    write_protocol(tmp_path / "megloc", Protocol())
    source = DatasetChoice("kapture", tmp_path / "scene")

    def names(*assignments: str) -> tuple[str, str]:
        options = options_of_preset(assignments=assignments)
        run = Run(source, "classic", options)
        return run.label, run.submission_below(tmp_path, tmp_path / "megloc").stem

    usual = ("kapture, classic", "kapture_eval_megloc-classic")
    assert names() == names("local_features.options.max_keypoints=800") == usual
    assert names("local_features=aliked") == (
        "kapture, classic with local_features=aliked",
        "kapture_eval_megloc-classic-aliked",
    )
    both = ('local_features=["sift", "xfeat"]', "global_features=netvlad")
    assert names(*both) == (
        "kapture, classic with local_features=sift+xfeat and global_features=netvlad",
        "kapture_eval_megloc-classic-sift+xfeat-netvlad",
    )


def test_a_dataset_of_kapture_folders_has_a_workspace_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    options = PipelineOptions()
    for root in (Path("house"), tmp_path / "house", Path("house/../house/")):
        place = Run(DatasetChoice("kapture", root), "modern", options).default_workspace
        assert place == Path("runs/kapture-house-modern")
    rendered = Run(DatasetChoice("synthetic-aachen", None), "classic", options)
    assert rendered.default_workspace == Path("runs/synthetic-aachen-classic")


@pytest.mark.parametrize("stem", ["../x", "a/b", ".x", "a b", "a\n"])
def test_a_pose_file_lies_nowhere_else(stem: str) -> None:
    with pytest.raises(ValidationError, match="pose_file_stem"):
        Protocol(pose_file_stem=stem)

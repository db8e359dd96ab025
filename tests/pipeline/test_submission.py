"""Pose files for servers: names, order, frames, poses of the rig, and provenance."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from poses import random_pose
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.evaluation.pose_files import read_pose_file, write_provenance
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.dataset_tables import (
    ImageGroup,
    Protocol,
    RelocalizationPair,
    SideTables,
    SimilarityTransform,
    World,
    write_protocol,
    write_side_tables,
    write_world,
)
from megloc_kapture.io.files import write_json_model
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.io.tables import write_status
from megloc_kapture.pipeline.datasets import DatasetChoice, check_dataset
from megloc_kapture.pipeline.evaluation_plan import Run
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.submission import (
    keep_submission,
    workspace_provenance,
    write_submission,
)
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.values import Camera, LocalizationResult, RigidTransform
from tests.pipeline.runs import manifest
from tests.worlds import folder_bytes

CAMERA = Sensor.from_camera(Camera("PINHOLE", 640, 480, (500, 500, 320, 240)))
SIDES = ("left", "rear", "right")
# the origin of 4Seasons' frames, and a scale
FAR = SimilarityTransform(
    quat_wxyz=(0.5, 0.5, -0.5, 0.5), translation=(4.1e6, 8.5e5, 4.8e6), scale=1.25
)


class Dataset:
    """An imported rig of three cameras at four timestamps, and a result for it."""

    def __init__(self, root: Path) -> None:
        self.root, self.tables, self.result = root, root / "megloc", root / "localized"
        rng = np.random.default_rng(0)
        self.rig = {side: random_pose(rng) for side in SIDES}
        self.cars = {time: random_pose(rng) for time in (10, 20, 30, 40)}
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
        self.groups = {
            image: ImageGroup(scored="/rear/" in image) for image in self.query.image_names()
        }
        self.write_tables(groups=self.groups)

    def write_tables(self, **tables: Any) -> None:
        rules = Protocol(dataset="robotcar")
        write_side_tables(self.tables, SideTables(protocol=rules, **tables))

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


def test_only_scored_images_are_written(dataset: Dataset, tmp_path: Path) -> None:
    dataset.localize(["dawn/left/10.jpg", "dawn/rear/10.jpg", "night/rear/40.jpg"], {})
    doubtful = [  # without a pose; only the second is scored
        LocalizationResult(name=name, confidence=0.3, **FAILED)
        for name in ("dawn/left/20.jpg", "night/rear/30.jpg")
    ]
    write_status(dataset.result / "status.csv", doubtful)
    counts, provenance = submit(dataset, tmp_path / "poses.txt")
    assert list(read_pose_file(tmp_path / "poses.txt")) == ["dawn/rear/10.jpg", "night/rear/40.jpg"]
    expected = {"queries": 12, "scored": 4, "poses": 2, "missing": 2, "doubtful": 1}
    assert counts == NONE | expected
    assert provenance["counts"] == counts
    assert provenance["missing"] == ["dawn/rear/20.jpg", "night/rear/30.jpg"]


def test_names_with_white_space_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    images = ["a b.jpg", "c d/e.jpg", "f.jpg"]
    records = {(time, "rear"): image for time, image in enumerate(images)}
    poses = dict.fromkeys(records, RigidTransform.identity())
    data = KaptureData({"rear": CAMERA}, {}, poses, records)
    write_sensors(tmp_path / "localized", data)
    place = tmp_path / "poses.txt"
    counts = write_submission(tmp_path / "localized", place, tables=None, provenance={})
    assert list(read_pose_file(place)) == ["f.jpg"]
    assert (counts["scored"], counts["poses"], counts["missing"]) == (3, 1, 2)
    assert "2 images are left out" in caplog.text and "'a b.jpg'" in caplog.text


def test_the_list_of_names_sets_names_and_order(dataset: Dataset, tmp_path: Path) -> None:
    names = {
        "night/rear/40.jpg": "rear/40.png",
        "dawn/rear/10.jpg": "rear/10.png",
        "night/rear/30.jpg": "rear/30.png",
    }
    dataset.write_tables(names=names)
    dataset.localize(dataset.query.image_names(), {})
    counts, _ = submit(dataset, tmp_path / "poses.txt")
    found = read_pose_file(tmp_path / "poses.txt")
    assert list(found) == list(names.values())
    assert found["rear/30.png"] == dataset.true_pose("night/rear/30.jpg")
    assert (counts["scored"], counts["poses"]) == (3, 3)


def test_poses_are_written_in_the_official_frame(dataset: Dataset, tmp_path: Path) -> None:
    write_world(dataset.tables, World(official_from_local=FAR))
    dataset.localize(["dawn/rear/10.jpg"], {})
    submit(dataset, tmp_path / "poses.txt")
    pose = read_pose_file(tmp_path / "poses.txt")["dawn/rear/10.jpg"].matrix()
    points = np.random.default_rng(0).normal(size=(5, 3)) * 10
    local = dataset.true_pose("dawn/rear/10.jpg").matrix()
    turn = Rotation.from_quat(np.roll(FAR.quat_wxyz, -1))
    official = 1.25 * turn.apply(points) + FAR.translation
    np.testing.assert_allclose(
        official @ pose[:3, :3].T + pose[:3, 3],
        1.25 * (points @ local[:3, :3].T + local[:3, 3]),
        atol=1e-8,
    )


def test_inconsistent_results_are_refused(dataset: Dataset, tmp_path: Path) -> None:
    place = tmp_path / "poses.txt"
    dataset.localize(dataset.query.image_names(), {})
    write_sensors(dataset.root / "query", replace(dataset.query, rigs={}))
    with pytest.raises(DataError, match="poses cannot be derived from the rig"):
        submit(dataset, place, from_rig=True)
    write_protocol(dataset.tables, Protocol(dataset="robotcar", pose_file_names="basename"))
    (dataset.tables / "groups.csv").unlink()
    with pytest.raises(DataError, match="would both be called '10.jpg'"):
        submit(dataset, place)
    stranger = replace(dataset.query, records_camera={(1, "left"): "other.jpg"})
    write_sensors(dataset.root / "query", stranger)
    with pytest.raises(DataError, match="is not among the queries of .*query"):
        submit(dataset, place)
    assert not place.exists()


def test_poses_of_the_rig_are_optional(dataset: Dataset, tmp_path: Path) -> None:
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
    counts, provenance = submit(dataset, tmp_path / "with.txt", from_rig=True)
    found = read_pose_file(tmp_path / "with.txt")
    # a fallback is replaced by a pose of the rig and gives none to others
    assert list(found) == ["dawn/rear/10.jpg", "dawn/rear/20.jpg"]
    assert (counts["poses"], counts["fallbacks"], counts["from_rig"]) == (2, 0, 2)
    for image, pose in found.items():
        np.testing.assert_allclose(pose.matrix(), dataset.true_pose(image).matrix(), atol=1e-9)
    assert provenance["counts"]["from_rig"] == 2
    # earlier poses of the rig are counted
    dataset.localize(["dawn/rear/10.jpg"], {"dawn/rear/10.jpg": {**FAILED, "fallback": "rig"}})
    counts, _ = submit(dataset, tmp_path / "poses.txt")
    assert (counts["poses"], counts["fallbacks"], counts["from_rig"]) == (1, 0, 1)


STAMPS = [1602074877390449152 + 33_333_333 * number for number in range(7)]
PAIRS = [(2, 5), (0, 4), (3, 6)]  # of an image of the map and a query; query 6 has no pose
DUMMY = "0.0 0.0 0.0 0.0 0.0 0.0 1.0"


def write_drives(root: Path) -> KaptureData:
    """Write a map, localized queries and relocalization pairs of 4Seasons; return both drives."""
    rng = np.random.default_rng(0)
    poses = [random_pose(rng) for _ in STAMPS]

    def drive(numbers: range, posed: range) -> KaptureData:
        folder = "ref" if numbers.start == 0 else "test"
        return KaptureData(
            sensors={"cam0": CAMERA},
            trajectories={(STAMPS[n], "cam0"): poses[n] for n in posed},
            records_camera={(STAMPS[n], "cam0"): f"{folder}/cam0/{STAMPS[n]}.png" for n in numbers},
        )

    mapping, localized = drive(range(4), range(4)), drive(range(4, 7), range(4, 6))
    write_sensors(root / "mapping", mapping)
    write_sensors(root / "query", replace(localized, trajectories={}))
    write_sensors(root / "localized", localized)
    names = [f"ref/cam0/{t}.png" if n < 4 else f"test/cam0/{t}.png" for n, t in enumerate(STAMPS)]
    rows = [RelocalizationPair("sub/a.txt", names[r], names[q]) for r, q in PAIRS]
    listed = SideTables(
        protocol=Protocol(dataset="4seasons", pose_file="mlad"),
        world=World(official_from_local=FAR),
        relocalization=rows,
    )
    write_side_tables(root / "megloc", listed)
    return KaptureData(
        sensors=mapping.sensors,
        rigs={"car": {"cam0": RigidTransform.identity()}},  # kapture's exporter needs rigs
        trajectories=mapping.trajectories | localized.trajectories,
        records_camera=mapping.records_camera | localized.records_camera,
    )


def test_mlad_files_equal_those_of_kapture_and_list_dummies(tmp_path: Path) -> None:
    from tools.kapture_export_4seasons_pairs import export_4seasons_pairfile

    both, pairs, place = tmp_path / "both", tmp_path / "pairs.txt", tmp_path / "submission"
    write_sensors(both, write_drives(tmp_path))
    pairs.write_text("".join(f"{STAMPS[r]} {STAMPS[q]}\n" for r, q in PAIRS))
    export_4seasons_pairfile(
        str(both), str(pairs), str(tmp_path / "theirs.txt"), heal_timestamps=False
    )
    counts = write_submission(
        tmp_path / "localized", place, tables=tmp_path / "megloc", provenance={}
    )
    expected = {"queries": 3, "scored": 3, "poses": 2, "missing": 1, "dummies": 1}
    assert counts == NONE | expected
    ours, theirs = np.loadtxt(place / "sub" / "a.txt"), np.loadtxt(tmp_path / "theirs.txt")
    np.testing.assert_array_equal(ours[:, :2], theirs[:, :2])
    # lengths are in official units
    np.testing.assert_allclose(ours[:, 2:5], 1.25 * theirs[:, 2:5], atol=1e-9)
    rotations, expected_rotations = (Rotation.from_quat(rows[:, 5:]) for rows in (ours, theirs))
    assert (rotations * expected_rotations.inv()).magnitude().max() < 1e-12
    last = (place / "sub" / "a.txt").read_text().splitlines()[-1]
    assert last == f"{STAMPS[3]} {STAMPS[6]} {DUMMY}"
    provenance = json.loads((tmp_path / "submission.json").read_text())
    dummy = f"sub/a.txt: ref/cam0/{STAMPS[3]}.png test/cam0/{STAMPS[6]}.png"
    assert provenance["dummies"] == [dummy] and list(provenance["files"]) == ["sub/a.txt"]


def test_provenance_has_options_only_of_the_same_localization(tmp_path: Path) -> None:
    stages, result = tmp_path / "stages", tmp_path / "localized"
    assert workspace_provenance(result) == {}
    done = manifest("localization", outputs=("localized", "timing.csv"))
    write_json_model(stages / "localization.json", done)
    options = {"dataset": "kapture", "preset": "classic", "options": {"map": "lift"}}
    for fingerprint in ("print of localization", "an older one"):
        submission = manifest("submission", options=options, inputs={"localization": fingerprint})
        write_json_model(stages / "submission.json", submission)
        expected = {"localization_fingerprint": "print of localization"}
        if fingerprint == "print of localization":
            expected |= {"preset": "classic", "options": {"map": "lift"}}
        assert workspace_provenance(result) == expected


def test_provenance_has_fingerprints_versions_and_the_weights_of_earlier_stages(
    dataset: Dataset, tmp_path: Path
) -> None:
    dataset.localize(["dawn/rear/10.jpg"], {})
    stages = dataset.result.parent / "stages"
    for one in (
        manifest("import"),
        manifest("local_features", options={"weights": {"superpoint.pth": "ab"}}),
        manifest("matches", inputs={"local_features": "print of local_features"}),
        manifest("global_features", options={"weights": {"netvlad.mat": "cd"}}),
        # a stage of another run
        manifest("ranking", options={"weights": {"lpips.pth": "ef"}}),
        manifest(
            "pose_refinement",
            options={"weights": {"field.pth": "01"}},
            inputs={"matches": "print of matches", "global_features": "an older one"},
            outputs=(dataset.result.name,),
        ),
    ):
        write_json_model(stages / f"{one.stage}.json", one)
    place = tmp_path / "poses.txt"
    _, provenance = submit(dataset, place)
    assert provenance["weights"] == {"field.pth": "01", "superpoint.pth": "ab"}
    assert provenance["dataset_fingerprint"] == "print of import"
    assert provenance["options"] == {"a": 1} and "megloc-kapture" in provenance["versions"]
    assert provenance["files"] == {"poses.txt": hashlib.sha256(place.read_bytes()).hexdigest()}
    # neither times nor durations, so that equal runs write equal files
    text = place.with_name("poses.txt.json").read_text()
    assert "2024" not in text and "1.5" not in text


@pytest.mark.parametrize(
    ("requested", "written", "message"),
    [
        ("aachen", "robotcar", r"aachen was requested, but .* is for dataset robotcar"),
        ("kapture", "aachen", "for dataset aachen"),
        ("aahcen", "aachen", "unknown dataset 'aahcen'; did you mean 'aachen'"),
    ],
)
def test_results_of_another_dataset_are_refused(
    requested: str, written: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match=message):
        check_dataset(requested, Protocol(dataset=written), tables=tmp_path)


def test_official_datasets_need_their_tables(tmp_path: Path) -> None:
    for name in ("synthetic-aachen", "aachen"):
        check_dataset("aachen", Protocol(dataset=name), tables=tmp_path)
    check_dataset("synthetic", Protocol(), tables=None)
    check_dataset("kapture", Protocol(dataset="my-own-scene"), tables=None)
    with pytest.raises(OptionError, match="protocol of aachen is missing; .*--side-tables"):
        check_dataset("aachen", Protocol(), tables=None)


@pytest.mark.parametrize(
    ("name", "stem"),
    [
        ("aachen", "Aachen_v1_1"),
        ("4seasons", "4Seasons"),
        ("synthetic-4seasons", "synthetic-4seasons"),
    ],
)
def test_pose_files_have_the_names_of_the_server(name: str, stem: str, tmp_path: Path) -> None:
    rules = protocol_of(name.removeprefix("synthetic-"))
    write_protocol(tmp_path / "megloc", rules)
    run = Run(DatasetChoice(name, None), "classic", PipelineOptions())
    end = "" if rules.pose_file == "mlad" else ".txt"
    expected = tmp_path / "submissions" / f"{stem}_eval_megloc-classic{end}"
    assert run.submission_below(tmp_path, tmp_path / "megloc") == expected


def test_labels_name_features_that_differ_from_the_preset(tmp_path: Path) -> None:
    write_protocol(tmp_path / "megloc", Protocol())
    source = DatasetChoice("kapture", tmp_path / "scene")

    def names(*assignments: str) -> tuple[str, str]:
        options = options_of_preset(assignments=assignments)
        run = Run(source, "classic", options)
        return run.label, run.submission_below(tmp_path, tmp_path / "megloc").stem

    usual = ("kapture, classic", "kapture_eval_megloc-classic")
    assert names() == names("local_features.options.max_keypoints=800") == usual
    both = ('local_features=["sift", "xfeat"]', "global_features=netvlad")
    assert names(*both) == (
        "kapture, classic with local_features=sift+xfeat and global_features=netvlad",
        "kapture_eval_megloc-classic-sift+xfeat-netvlad",
    )


NAME, FOLDER = "Aachen_v1_1_eval_megloc-classic", "4Seasons_eval_megloc-1.5"


def pose_file(run: Path, text: str, *, folder: bool = False) -> Path:
    place = run / "submissions" / (FOLDER if folder else f"{NAME}.txt")
    files = [place / "a.txt", place / "b.txt"] if folder else [place]
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    names = [file.name for file in files] if folder else None
    write_provenance(place, {"preset": text}, counts={}, files=names)
    return place


def contents(place: Path) -> dict[str, bytes]:
    return folder_bytes(place) if place.is_dir() else {"": place.read_bytes()}


@pytest.mark.parametrize("folder", [False, True])
def test_different_pose_files_get_numbers_and_equal_ones_are_reused(
    tmp_path: Path, folder: bool
) -> None:
    out, texts = tmp_path / "kept", ("first", "second", "third")
    places = [pose_file(tmp_path / text, text, folder=folder) for text in texts]
    kept = [keep_submission(place, out) for place in places]
    name = FOLDER if folder else NAME
    found = [place.name.removesuffix(".txt") for place in kept]
    assert found == [name, f"{name}-2", f"{name}-3"]
    for place, source, text in zip(kept, places, texts, strict=True):
        assert contents(place) == contents(source)
        provenance = json.loads(place.with_name(f"{place.name}.json").read_text())
        names = ["a.txt", "b.txt"] if folder else [place.name]
        assert list(provenance["files"]) == names and provenance["preset"] == text
    before = folder_bytes(out)
    # the provenance of the first run stays
    again = pose_file(tmp_path / "again", "second", folder=folder)
    for place, expected in zip([*reversed(places), again], [*kept[::-1], kept[1]], strict=True):
        assert keep_submission(place, out) == expected
    assert folder_bytes(out) == before


def test_a_missing_pose_file_is_refused(tmp_path: Path) -> None:
    place = pose_file(tmp_path / "run", "a\n")
    place.unlink()
    with pytest.raises(DataError, match="--from submission"):
        keep_submission(place, tmp_path / "kept")
    assert not (tmp_path / "kept").exists()

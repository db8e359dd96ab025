"""``megloc eval``: what runs again and what does not, and that the result is always the same."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aachen_files import write_v1_0

from megloc_kapture.io.images import write_depth_map, write_image
from megloc_kapture.io.kapture import KaptureFolder, Sensor, read_pairs, write_sensors
from megloc_kapture.io.tables import read_status
from megloc_kapture.values import RigidTransform

Contents = Callable[[Path], dict[str, bytes]]

STAGES = (
    *("import", "local_features", "global_features", "mapping_pairs", "mapping_matches", "map"),
    *("query_pairs", "query_matches", "localization", "submission", "evaluation"),
)
POSES = "submissions/kapture_eval_megloc-classic.txt"
# dates and durations stand in these, and nowhere else
DATED = ("stages/", "timing.csv")


@pytest.fixture
def evaluate(megloc: Any) -> Callable[..., Any]:
    """Runs ``megloc eval kapture`` as the finished run was."""

    def run(root: Path, workspace: Path, *arguments: str, status: int = 0) -> Any:
        done = megloc(
            *("eval", "kapture", "--root", root, "--workspace", workspace),
            *("--set", "local_features.options.max_keypoints=800"),
            *(() if "--executor" in arguments else ("--executor", "inline")),
            *arguments,
        )
        assert done.status == status, done.err
        return done

    return run


def states(err: str) -> dict[str, str]:
    """Stage -> what the last line about it says, of those that have one."""
    told = dict(line.split(": ", 1) for line in err.splitlines() if ": " in line)
    return {stage: told[stage] for stage in STAGES if stage in told}


def ran(err: str) -> list[str]:
    """The stages that have been run."""
    return [stage for stage, told in states(err).items() if told.endswith(" s")]


def reasons(err: str) -> dict[str, str]:
    """Why a stage was run, as told before it was."""
    found: dict[str, str] = {}
    for line in err.splitlines():
        place, _, told = line.partition(": ")
        stage, _, numbered = place.partition(", stage ")
        if stage in STAGES:
            assert not numbered or re.fullmatch(r"\d+ of \d+", numbered)
            found.setdefault(stage, told)
    return found


def lasting(found: dict[str, bytes], *but: str) -> dict[str, bytes]:
    """What has to be the same in every run."""
    return {n: c for n, c in found.items() if not n.startswith((*DATED, *but))}


def recall(workspace: Path) -> list[float]:
    """Of all queries, at each threshold."""
    rows = json.loads((workspace / "evaluation" / "recall.json").read_text())["rows"]
    (row,) = (row for row in rows if row["name"] == "all")
    return [at["recall"] for at in row["recall"]]


# ------------------------------------------------------------------ what is there at the end


def test_the_pose_file_of_each_result_is_among_the_submissions(
    megloc: Any, scene: Path, workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (workspace.parent / "runs").mkdir()
    run = workspace.rename(workspace.parent / "runs" / f"kapture-{scene.name}-classic")
    monkeypatch.chdir(workspace.parent)
    command = ("eval", "kapture", "--root", scene, "--executor", "inline")
    same = ("--set", "local_features.options.max_keypoints=800")
    other = (*same, "--set", "localization.pose.max_error_px=6")
    first, second = Path(POSES), Path(POSES.replace(".txt", "-2.txt"))
    done = megloc(*command, *same)
    assert "nothing to do" in done.err and f"pose file  {first}\n" in done.out
    poses = first.read_bytes()
    assert poses == (run / POSES).read_bytes()
    assert Path(f"{POSES}.json").read_bytes() == (run / f"{POSES}.json").read_bytes()
    until = ("--until", "submission")  # it is said without the evaluation as well
    done = megloc(*command, *other, *until)
    assert f"{first} belongs to another result and is kept" in done.err
    assert f"pose file  {second}\n" in done.out
    assert first.read_bytes() == poses != second.read_bytes() == (run / POSES).read_bytes()
    # back again, and into a folder of one's own
    assert f"pose file  {first}\n" in megloc(*command, *same, *until).out
    assert len(list(Path("submissions").iterdir())) == 4
    done = megloc(*command, *same, "--workspace", run, "--submissions", "mine")
    assert done.out.splitlines()[-2] == f"pose file  {Path('mine') / first.name}"
    (run / POSES).unlink()
    assert megloc(*command, *same, "--workspace", run).status == 0  # nobody asked for a copy
    done = megloc(*command, *same, *until, "--workspace", run, "--submissions", "kept")
    assert done.status == 2 and "no such file; --from submission rewrites it" in done.err
    again = ("--from", "submission", *until, "--workspace", run, "--submissions", "kept")
    done = megloc(*command, *same, *again)
    assert done.out == f"pose file  {Path('kept') / first.name}\n"
    assert not done.err.count("evaluation")


def test_the_workspace_has_what_is_promised(finished: Path, scene: Path) -> None:
    for place in (
        *("mapping", "query", "query_gt", "megloc/protocol.json", "map", "localized"),
        *("local_features/rootsift/keypoints/keypoints.txt", "pairs/mapping.txt"),
        *("local_features/rootsift/descriptors/descriptors.txt", "pairs/query.txt"),
        "global_features/vlad_rootsift/global_features/global_features.txt",
        "matches/mapping/local_features/rootsift/matches",
        "matches/query/local_features/rootsift/matches",
        *("map/reconstruction/points3d.txt", "map/reconstruction/observations.txt"),
        *("localized/sensors/trajectories.txt", "localized/status.csv", "timing.csv"),
        *(POSES, POSES + ".json"),
        *("evaluation/recall.json", "evaluation/recall.txt", "evaluation/report.html"),
        *(f"stages/{stage}.json" for stage in STAGES),
    ):
        assert (finished / place).exists(), place
    assert list((finished / ".partial").iterdir()) == []
    # images are links to the dataset
    for part in ("mapping", "query"):
        link = finished / part / "sensors" / "records_data"
        assert link.readlink() == scene.resolve() / part / "sensors" / "records_data"
    assert [p for p in finished.rglob("*.jpg") if not p.is_symlink() and p.is_file()] == []
    # all queries are localized well
    assert recall(finished) == [1.0] * 4
    statuses = read_status(finished / "localized" / "status.csv")
    assert len(statuses) == 4
    assert all(s.status == "localized" and s.fallback == "none" for s in statuses.values())
    # a manifest says what was done
    manifest = json.loads((finished / "stages" / "local_features.json").read_text())
    choice = {"name": "rootsift", "options": {"max_keypoints": 800}}
    assert manifest["options"]["local_features"] == [choice]
    assert manifest["counts"]["images"] == 11
    code = "code of megloc_kapture.features.rootsift.RootSift"
    assert set(manifest["inputs"]) == {"import", code}
    assert manifest["seconds"] > 0 and manifest["versions"]["pycolmap"]


def test_where_query_poses_are_given_no_stage_sees_them(
    evaluate: Any, dataset: Path, finished: Path
) -> None:
    shutil.copyfile(
        dataset / "query_gt/sensors/trajectories.txt", dataset / "query/sensors/trajectories.txt"
    )
    evaluate(dataset, dataset.parent / "run", "--until", "import")
    assert KaptureFolder(dataset.parent / "run" / "query").read().poses() == {}
    assert not (dataset.parent / "run" / "local_features").exists()


# ------------------------------------------------------------------ again


def test_the_second_run_does_nothing_and_says_so(
    evaluate: Any, scene: Path, workspace: Path, contents: Contents
) -> None:
    def times() -> dict[str, int]:
        paths = (path for path in workspace.rglob("*") if not path.is_symlink())
        return {str(p): p.stat().st_mtime_ns for p in paths}

    before, files = times(), contents(workspace)
    del before[str(workspace / "stages")]
    done = evaluate(scene, workspace)
    assert states(done.err) == dict.fromkeys(STAGES, "up to date")
    assert "nothing to do: every stage is up to date" in done.err
    assert "pose file" in done.out and "100.0" in done.out
    after = times()
    del after[str(workspace / "stages")]
    assert after == before
    assert contents(workspace) == files


def test_an_option_of_localization_reruns_what_follows_only(
    evaluate: Any, scene: Path, workspace: Path
) -> None:
    done = evaluate(scene, workspace, "--set", "localization.pose.max_error_px=6")
    assert ran(done.err) == ["localization", "submission", "evaluation"]
    assert reasons(done.err)["localization"] == ("options changed: localization.pose.max_error_px")
    assert reasons(done.err)["evaluation"] == "localization changed"
    # and back again
    until = ("--until", "submission")
    assert ran(evaluate(scene, workspace, *until).err) == ["localization", "submission"]
    # thresholds are written by the import, and change nothing before the submission
    done = evaluate(scene, workspace, "--thresholds", "0.001,1", "0.5,5")
    assert ran(done.err) == ["import", "submission", "evaluation"]
    assert reasons(done.err)["import"] == "options changed: protocol.thresholds"


def test_a_changed_image_reruns_everything_and_a_moved_dataset_the_import(
    evaluate: Any, dataset: Path, finished: Path
) -> None:
    run, image = dataset.parent / "run", dataset / "mapping/sensors/records_data/0005.jpg"
    until = ("--until", "localization")
    evaluate(dataset, run, *until)
    moved = dataset.rename(dataset.with_name("moved"))
    assert ran(evaluate(moved, run, *until).err) == ["import"]
    moved.rename(dataset)
    with open(image, "ab") as file:
        file.write(b"\0")
    done = evaluate(dataset, run, *until)
    assert ran(done.err) == list(STAGES[:9])
    assert reasons(done.err)["import"] == "dataset files changed"
    # its pixels are the same
    poses = "localized/sensors/trajectories.txt"
    assert (run / poses).read_bytes() == (finished / poses).read_bytes()


# ------------------------------------------------------------------ parts of a run


def test_import_options_are_those_of_the_dataset(megloc: Any, tmp_path: Path) -> None:
    version = ("--root", write_v1_0(tmp_path / "root"), "--import-option", "version=1.1")
    done = megloc("eval", "aachen", *version, "-w", tmp_path / "run", "--dry-run")
    assert done.status == 2 and "the model of Aachen Day-Night v1.1 is missing" in done.err
    done = megloc("eval", "aachen", "--root", tmp_path / "root", "--import-option", "version")
    assert done.status == 2 and "--import-option takes key=value" in done.err


def test_queries_with_depth_are_refined_and_others_are_not(
    evaluate: Any, dataset: Path, tmp_path: Path
) -> None:
    assert "refine_poses" not in evaluate(dataset, tmp_path / "run", "--dry-run").err
    folder = KaptureFolder(dataset / "query")
    data = folder.read()
    (timestamp, camera), *_ = data.records_camera
    depth = Sensor.from_camera(data.sensors[camera].camera(), name="tof", sensor_type="depth")
    rig = {sensor: RigidTransform.identity() for sensor in (camera, "tof")}
    with_depth = replace(
        data,
        sensors={**data.sensors, "tof": depth},
        rigs={"rig": rig},
        records_depth={(timestamp, "tof"): "a.depth"},
    )
    write_sensors(dataset / "query", with_depth)
    size = depth.camera()
    write_depth_map(folder.depth_path("a.depth"), np.ones((size.height, size.width)))
    told = evaluate(dataset, tmp_path / "run", "--dry-run").err.splitlines()
    assert "refine_poses: would run (not done yet)" in told
    off = evaluate(dataset, tmp_path / "run", "--dry-run", "--set", "pose_refinement.by=[]")
    assert "refine_poses" not in off.err


def test_from_takes_what_another_tool_put_there(
    evaluate: Any, scene: Path, workspace: Path
) -> None:
    pairs = read_pairs(workspace / "pairs" / "query.txt")
    nearest = {pair.query: pair.map for pair in reversed(pairs)}
    rows = [f"{query}, {image}, 1.0\n" for query, image in sorted(nearest.items())]
    (workspace / "pairs" / "query.txt").write_text("".join(rows))
    done = evaluate(scene, workspace, "--from", "query_matches", "--until", "localization")
    assert ran(done.err) == list(STAGES[7:9])
    assert set(map(states(done.err).get, STAGES[:6])) == {"used as is"}
    statuses = read_status(workspace / "localized" / "status.csv")
    assert {q: s.candidates for q, s in statuses.items()} == {
        query: (image,) for query, image in nearest.items()
    }


# ------------------------------------------------------------------ the same bytes


def test_processes_give_the_same_bytes(
    evaluate: Any, scene: Path, finished: Path, tmp_path: Path, contents: Contents
) -> None:
    evaluate(scene, tmp_path / "run", "--executor", "processes", "--workers", "2")
    expected, found = lasting(contents(finished)), lasting(contents(tmp_path / "run"))
    for folder in ("local_features", "map", "localized", "submissions", "evaluation"):
        assert any(name.startswith(f"{folder}/") for name in expected)
    assert found == expected


# ------------------------------------------------------------------ results


def test_queries_that_fail_are_misses_and_low_recall_fails_when_asked_for(
    evaluate: Any, dataset: Path, finished: Path
) -> None:
    images = dataset / "query/sensors/records_data"
    (images / "0004.jpg").write_bytes((images / "0004.jpg").read_bytes()[:20_000])
    write_image(images / "0007.jpg", np.zeros((100, 200, 3), np.uint8))
    (images / "0010.jpg").unlink()
    run = dataset.parent / "run"
    done = evaluate(dataset, run, "--fail-below", "0.3", status=3)
    assert "recall 0.250 is below 0.300" in done.err
    assert evaluate(dataset, run, "--fail-below", "0.25").status == 0
    statuses = read_status(run / "localized" / "status.csv")
    failed = {name: one.reason for name, one in statuses.items() if one.status == "failed"}
    assert set(statuses) - set(failed) == {"0001.jpg"}
    assert set(failed) == {"0004.jpg", "0007.jpg", "0010.jpg"}
    assert all(one.startswith("the image cannot be used: ") for one in failed.values())
    assert "200x100, its camera expects 400x300" in failed["0007.jpg"]
    # they are not in the pose file, and the other one does not mind
    expected = (finished / POSES).read_text().splitlines(keepends=True)
    assert (run / POSES).read_text() == "".join(r for r in expected if "0001" in r)


def test_inverted_poses_are_refused_unless_forced(
    evaluate: Callable[..., Any], dataset: Path, tmp_path: Path
) -> None:
    folder = KaptureFolder(dataset / "mapping")
    data = folder.read()
    inverted = {key: pose.inverse() for key, pose in data.trajectories.items()}
    write_sensors(folder.root, replace(data, trajectories=inverted))
    done = evaluate(dataset, tmp_path / "ws", status=2)
    assert "; poses inverted (camera-to-world, world_from_cam), " in done.err
    done = evaluate(dataset, tmp_path / "ws", "--force", "--until", "mapping_matches")
    assert "up to date" in done.err and "mapping_matches: " in done.err

"""A stage of another package, found by its entry point: in the plan, on the command line."""

from __future__ import annotations

import json
import shutil
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.cli.main import main
from megloc_kapture.errors import OptionError, PluginError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.datasets import choose_dataset
from megloc_kapture.pipeline.evaluation_plan import Run, plan_evaluation
from megloc_kapture.pipeline.plan import Workspace, all_kept, run_plan
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.stages.stage import Stage
from megloc_kapture.stages.work import Work
from tests.pipeline.runs import run_command

SOURCE = Path(__file__).parent / "outside_stage"
SMALL = "local_features.options.max_keypoints=200"


@pytest.fixture(autouse=True)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The package as pip leaves it: its modules, and metadata with its entry points."""
    site = tmp_path / "site"
    shutil.copytree(SOURCE / "keypoint_counts", site / "keypoint_counts")
    project = tomllib.loads((SOURCE / "pyproject.toml").read_text())["project"]
    info = site / "keypoint_counts-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: 1.0\n"
    )
    text = "".join(
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in entries.items())
        for group, entries in project["entry-points"].items()
    )
    (info / "entry_points.txt").write_text(text)
    monkeypatch.syspath_prepend(site)
    yield site
    sys.modules.pop("keypoint_counts", None)


def planned(scene: Path, stages: dict[str, Any]) -> list[Stage]:
    options = options_of_preset(
        changes=[{"stages": stages}], assignments=[SMALL, "global_features.options.num_clusters=4"]
    )
    return plan_evaluation(Run(choose_dataset("kapture", scene), "classic", options))


def expected_counts(workspace: Workspace) -> list[str]:
    folder = KaptureFolder(workspace.path("mapping"), features_dirs=[workspace.root])
    keypoints = folder.keypoints("rootsift")
    return [f"{name},{keypoints.length(name)}" for name in folder.read().image_names()]


def test_it_is_part_of_the_plan_with_manifest_and_progress(scene: Path, tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "workspace")
    progress: list[tuple[int, str]] = []

    def track(items: Iterable[Any], total: int, label: str) -> Iterator[Any]:
        progress.append((total, label))
        return iter(items)

    stages = planned(scene, {"count_keypoints": {}})
    names = [stage.name for stage in stages]
    assert names.index("count_keypoints") == names.index("local_features") + 1
    run_plan(stages, workspace, Work(track=track), last="count_keypoints")
    images = KaptureFolder(scene / "mapping").read().image_names()
    assert (len(images), "counting") in progress
    assert workspace.path("counts.csv").read_text().splitlines() == expected_counts(workspace)
    manifest = json.loads(workspace.manifest_path("count_keypoints").read_text())
    assert manifest["options"] == {"least": 0} and manifest["counts"] == {"images": len(images)}
    code = "code of keypoint_counts.CountKeypoints"
    assert set(manifest["inputs"]) == {"import", "local_features", code}
    assert all_kept(run_plan(stages, workspace, last="count_keypoints"))
    # another option, and it alone runs again
    again = run_plan(
        planned(scene, {"count_keypoints": {"least": 10_000}}), workspace, last="count_keypoints"
    )
    assert [report.name for report in again if report.state == "run"] == ["count_keypoints"]
    assert workspace.path("counts.csv").read_text() == ""


def test_it_has_a_command_of_its_own(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    workspace = Workspace(tmp_path / "workspace")

    def megloc(*arguments: str) -> tuple[int | str | None, str]:
        with pytest.raises(SystemExit) as end:
            main(arguments)
        printed = capsys.readouterr()
        return end.value.code, printed.out + printed.err

    assert "count-keypoints" in megloc("--help")[1]
    text = megloc("count-keypoints", "--help")[1]
    assert "Count the keypoints of every map image." in text
    sys.modules["keypoint_counts"].CountKeypoints.__doc__ = None  # not that of Stage
    assert "Run the stage count_keypoints." in megloc("count-keypoints", "--help")[1]
    assert "least = 0\n" in megloc("options", "count_keypoints")[1]
    command = ("count-keypoints", "-w", str(workspace.root), "--executor", "inline")
    assert megloc(*command) == (2, f"megloc: {workspace.root} is not a workspace of megloc eval\n")
    run_plan(planned(scene, {}), workspace, last="import")
    status, text = megloc(*command)
    assert status == 2 and "count_keypoints reads local_features, which no stage" in text
    run_plan(planned(scene, {}), workspace, last="local_features")
    status, text = megloc(*command)
    assert status == 0 and "count_keypoints: 7 images" in text
    assert workspace.path("counts.csv").read_text().splitlines() == expected_counts(workspace)
    # the plan finds it done
    stages = planned(scene, {"count_keypoints": {}})
    assert all_kept(run_plan(stages, workspace, last="count_keypoints"))
    status, text = megloc(*command, "--set", "least=100000")
    assert status == 0 and "count_keypoints: 0 images" in text
    status, text = megloc(*command, "--set", "most=1")
    assert status == 2 and "count_keypoints" in text and "most" in text


def test_a_stage_that_cannot_be_loaded_leaves_the_other_commands_alone(
    installed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (installed / "keypoint_counts" / "__init__.py").write_text("raise RuntimeError('broken')")
    run_command("--help")
    run_command("info", "--help")
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        main(["count-keypoints", "-w", "workspace"])
    assert end.value.code == 2
    assert "cannot be loaded: broken" in capsys.readouterr().err


def test_a_stage_may_be_registered_with_a_hyphen(
    installed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entries = next(installed.glob("*.dist-info")) / "entry_points.txt"
    entries.write_text(entries.read_text().replace("count_keypoints =", "count-keypoints ="))
    run_command("count-keypoints", "--help")
    assert "Count the keypoints" in capsys.readouterr().out


def test_what_cannot_be_planned_is_refused(scene: Path) -> None:
    with pytest.raises(PluginError, match="no plugin 'count_points' in megloc_kapture.stages"):
        planned(scene, {"count_points": {}})
    with pytest.raises(
        PluginError, match="'count_keypoints' rejects its options: unknown option 'most'"
    ):
        planned(scene, {"count_keypoints": {"most": 1}})
    kind = sys.modules["keypoint_counts"].CountKeypoints
    del kind.Options  # a stage needs none, and no counts
    (stage,) = (s for s in planned(scene, {"count_keypoints": {}}) if isinstance(s, kind))
    assert stage.settings() == {}
    foreign = type("Foreign", (), {"name": "foreign"})
    with pytest.raises(PluginError, match="'foreign' is not derived from megloc_kapture.stages.st"):
        run_plan([foreign()], Workspace(scene.parent / "workspace"))
    kind.reads = ("depth_maps",)
    with pytest.raises(OptionError, match=r"count_keypoints reads depth_maps, which no stage"):
        planned(scene, {"count_keypoints": {}})

"""A stopped run goes on inside a stage; a changed image or plugin costs what it changes."""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from megloc_kapture.pipeline.datasets import choose_dataset
from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.plan import StageReport, run_plan
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.run import Run
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.work import Work

PLUGINS = '''
import cv2
import numpy as np
from megloc_kapture.plugins import PoseRefinement
from megloc_kapture.values import LocalFeatures, RigidTransform


class Corners:
    """Grey values around strong corners."""

    name = "corners"

    def extract(self, image, mask=None):
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        found = cv2.goodFeaturesToTrack(grey, 60, 0.01, 7).reshape(-1, 2)
        rows = np.stack([cv2.getRectSubPix(grey, (9, 9), tuple(map(float, p))) for p in found])
        rows = rows.reshape(len(rows), -1).astype(np.float32) + SHIFT
        keypoints = np.float32(found + 0.5)
        return LocalFeatures(keypoints, np.ones(len(found), np.float32), rows)


class Thumbnail:
    """A small image as a vector."""

    name = "thumbnail"

    def describe(self, image):
        small = cv2.resize(image, (8, 8), interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
        return small / np.linalg.norm(small)


class Nearest:
    """The nearest descriptor, mutually."""

    def match(self, a, b):
        distances = np.linalg.norm(a.descriptors[:, None] - b.descriptors[None], axis=2)
        there, back = distances.argmin(axis=1), distances.argmin(axis=0)
        rows = np.flatnonzero(back[there] == np.arange(len(there)))
        return np.stack([rows, there[rows]], axis=1), np.ones(len(rows), np.float32)


class Nudge:
    """A pose that is moved by what the images look like."""

    name = "nudge"

    def refine(self, query, camera, cam_from_world, references, scene):
        brightness = [scene.query_image(query).mean(), scene.map_image(references[0]).mean()]
        moved = RigidTransform((1.0, 0.0, 0.0, 0.0), (*np.float32(brightness) / 1000, 0.0))
        return PoseRefinement(moved @ cam_from_world, "", {"brightness": brightness[0]})
'''
ENTRIES = """
[megloc_kapture.local_features]
corners = patches.plugins:Corners
[megloc_kapture.global_features]
thumbnail = patches.plugins:Thumbnail
[megloc_kapture.matchers]
nearest = patches.plugins:Nearest
[megloc_kapture.pose_refiners]
nudge = patches.plugins:Nudge
"""
OPTIONS = ("local_features=corners", "global_features=thumbnail", "matching=nearest")


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The package of the plugins, as pip leaves it."""
    site = tmp_path / "site"
    info = site / "patches-1.2.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: patches\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(ENTRIES)
    folder = site / "patches"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "shift.py").write_text("SHIFT = 0\n")
    (folder / "plugins.py").write_text(f"from patches.shift import SHIFT\n{PLUGINS}")
    monkeypatch.syspath_prepend(site)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield folder
    forget_modules()


def forget_modules() -> None:
    """As in a new process."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "patches"]:
        del sys.modules[name]


class Stopped(BaseException):
    """As a signal ends a run."""


@dataclass
class Runs:
    """Runs of a scene in a workspace, until the queries are matched."""

    scene: Path
    root: Path
    options: tuple[str, ...] = OPTIONS
    last: str = "query_matches"
    told: dict[str, tuple[int, str]] = field(default_factory=dict)
    """Items that were done and their label, by the stage's first word."""

    def run(
        self,
        *,
        stop_at: tuple[str, int] | None = None,
        executor: Executor | None = None,
        **how: Any,
    ) -> dict[str, StageReport]:
        self.told.clear()
        forget_modules()

        def track(items: Iterable[Any], total: int, label: str) -> Iterator[Any]:
            self.told[re.split("[ ,]", label)[0]] = total, label
            for number, item in enumerate(items):
                if stop_at == (re.split("[ ,]", label)[0], number):
                    raise Stopped
                yield item

        workspace = Workspace(self.root)
        options = options_of_preset(assignments=self.options)
        run = Run(choose_dataset("kapture", self.scene), "classic", options)
        with workspace.lock():
            work = Work(executor, track)
            reports = run_plan(plan_evaluation(run), workspace, work, **{"last": self.last, **how})
        assert list(workspace.path(".partial").iterdir()) == []
        return {report.name: report for report in reports}

    def stopped(self, label: str, number: int) -> Path:
        """Stop a run; returns what it left."""
        with pytest.raises(Stopped):
            self.run(stop_at=(label, number))
        (left,) = [path for path in (self.root / ".partial").iterdir() if "~" not in path.name]
        return left

    def check_undisturbed(self) -> None:
        """Compare what there is with what a run from nothing writes of the scene as it is now."""
        fresh = replace(self, root=self.root.with_name("undisturbed"), told={})
        shutil.rmtree(fresh.root, ignore_errors=True)
        fresh.run()
        assert contents(self.root) == contents(fresh.root)


def contents(root: Path) -> dict[str, bytes]:
    """All that stages wrote, by path."""
    files = (path for path in sorted(root.rglob("*")) if path.is_file() and not path.is_symlink())
    named = {path.relative_to(root).as_posix(): path for path in files}
    hidden = ("stages/", "megloc/", "timing", ".")
    return {name: path.read_bytes() for name, path in named.items() if not name.startswith(hidden)}


@pytest.fixture
def runs(package: Path, scene: Path, tmp_path: Path) -> Runs:
    copy = shutil.copytree(scene, tmp_path / "dataset", symlinks=True)
    return Runs(copy, tmp_path / "run")


def paint(scene: Path, image: str) -> None:
    """Change an image visibly."""
    path = scene / image
    pixels = cv2.imread(str(path))
    pixels[40:90, 40:90] = 255 - pixels[40:90, 40:90]
    cv2.imwrite(str(path), pixels)


def kept_of(reports: dict[str, StageReport]) -> dict[str, str]:
    return {name: report.kept_items for name, report in reports.items() if report.kept_items}


CHANGED = "mapping/sensors/records_data/0003.jpg"


def test_a_stopped_run_goes_on_inside_the_stage(runs: Runs) -> None:
    runs.stopped("corners", 4)
    # and it may be stopped again
    runs.stopped("corners", 3)
    assert runs.told["corners"] == (7, "corners features, 4 of 11 kept")
    left = runs.stopped("thumbnail", 5)
    assert left.name == "global_features"
    runs.stopped("matching", 2)
    with ThreadPoolExecutor(2) as executor:
        reports = runs.run(executor=executor)
    assert [reports[f"{name}_features"].state for name in ("local", "global")] == ["kept"] * 2
    assert reports["mapping_matches"].kept_items == "11 of 21 kept"
    assert reports["query_matches"].kept_items == ""
    runs.check_undisturbed()


def test_one_changed_image_costs_one_image_and_its_pairs(runs: Runs) -> None:
    runs.run()
    paint(runs.scene, CHANGED)
    reports = runs.run()
    assert runs.told["corners"][0] == runs.told["thumbnail"][0] == 1
    assert kept_of(reports) == {
        "local_features": "10 of 11 kept",
        "global_features": "10 of 11 kept",
        "mapping_matches": "15 of 21 kept",  # 7 images, all pairs: 6 are of the one
        "query_matches": "24 of 28 kept",
    }
    runs.check_undisturbed()


def test_one_new_image_costs_one_image(runs: Runs) -> None:
    records = runs.scene / "mapping" / "sensors" / "records_camera.txt"
    text = records.read_text()
    records.write_text("".join(line for line in text.splitlines(True) if "0003.jpg" not in line))
    runs.run()
    records.write_text(text)
    runs.run()
    assert runs.told["corners"] == (1, "corners features, 10 of 11 kept")
    runs.check_undisturbed()
    # and one image less leaves nothing of itself
    records.write_text("".join(line for line in text.splitlines(True) if "0003.jpg" not in line))
    runs.run()
    assert not any("0003.jpg" in name for name in contents(runs.root))


def test_a_pose_a_mask_and_another_camera_count(runs: Runs) -> None:
    runs.run(last="mapping_matches")
    sensors = runs.scene / "mapping" / "sensors"
    lines = (sensors / "trajectories.txt").read_text().splitlines()
    *row, z = lines[-1].split(",")
    moved = ",".join([*row, str(float(z) + 0.1)])
    (sensors / "trajectories.txt").write_text("\n".join([*lines[:-1], moved]) + "\n")
    reports = runs.run(last="mapping_matches")
    assert reports["local_features"].kept_items == "11 of 11 kept"
    assert reports["mapping_matches"].kept_items == "15 of 21 kept"  # poses verify matches
    mask = sensors / "masks/0003.jpg.png"
    mask.parent.mkdir()
    size = cv2.imread(str(runs.scene / CHANGED)).shape[:2]
    cv2.imwrite(str(mask), np.full(size, 255, np.uint8))
    runs.run(last="mapping_matches")
    assert runs.told["corners"] == (1, "corners features, 10 of 11 kept")
    assert runs.told["matching"] == (0, "matching, 21 of 21 kept")  # the same features
    table = sensors / "sensors.txt"
    text = re.sub(r"(PINHOLE, *\d+, *\d+, *)[\d.]+", r"\g<1>333.25", table.read_text())
    table.write_text(text)
    reports = runs.run(last="mapping_matches")
    assert reports["local_features"].kept_items == "11 of 11 kept"
    assert reports["mapping_matches"].kept_items == ""


@pytest.mark.parametrize("cut", ["a file", "the journal", "a file that all share"])
def test_what_is_not_whole_is_done_again(runs: Runs, cut: str) -> None:
    left = runs.stopped("corners", 5)
    name = {
        "a file": "local_features/corners/descriptors/0002.jpg.desc",
        "the journal": ".items",
        "a file that all share": "local_features/corners/keypoints/keypoints.txt",
    }[cut]
    content = (left / name).read_bytes()
    (left / name).write_bytes(content[:-30])
    runs.run()
    expected = "" if cut.endswith("share") else ", 4 of 11 kept"
    assert runs.told["corners"][1] == f"corners features{expected}"
    runs.check_undisturbed()


def test_a_file_of_the_output_that_is_cut_costs_one_image(runs: Runs) -> None:
    runs.run()
    place = runs.root / "local_features/corners/keypoints/0005.jpg.kpt"
    place.write_bytes(place.read_bytes()[:-12])
    reports = runs.run()
    assert reports["local_features"].kept_items == "10 of 11 kept"
    assert reports["mapping_matches"].state == "kept"
    # of the same size and time it is noticed where all is compared
    times = place.stat()
    place.write_bytes(bytes(times.st_size))
    os.utime(place, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert runs.run(verify=True)["local_features"].kept_items == "10 of 11 kept"
    runs.check_undisturbed()


def test_what_is_asked_for_again_is_done_whole(runs: Runs) -> None:
    runs.run()
    with pytest.raises(Stopped):
        runs.run(first="local_features", stop_at=("corners", 6))
    assert runs.told["corners"] == (11, "corners features")
    reports = runs.run()
    assert runs.told["corners"] == (5, "corners features, 6 of 11 kept")
    assert reports["mapping_matches"].kept_items == ""


def test_changed_code_of_a_plugin_makes_its_stage_run_again(runs: Runs, package: Path) -> None:
    before = runs.run()
    assert before["local_features"].why == "not done yet"
    with open(package / "plugins.py", "a") as file:
        file.write("# better explained\n")
    reports = runs.run()
    assert {name: report.why for name, report in reports.items() if report.why} == {
        "local_features": "code of patches.plugins.Corners changed",
        "global_features": "code of patches.plugins.Thumbnail changed",
        "mapping_matches": "code of patches.plugins.Nearest changed",
        "query_matches": "code of patches.plugins.Nearest changed",
    }
    assert all(report.kept_items == "" for report in reports.values())
    # another module of its package, and what it writes
    (package / "shift.py").write_text("SHIFT = 1\n")
    assert runs.run(last="local_features")["local_features"].why.startswith("code of patches")
    assert "code of" in runs.run(dry_run=True)["global_features"].why
    # and a new release
    runs.run(last="local_features")
    metadata = package.parent / "patches-1.2.dist-info" / "METADATA"
    metadata.write_text(metadata.read_text().replace("1.2", "1.3"))
    again = runs.run(last="local_features")["local_features"]
    assert again.why == "code of patches.plugins.Corners changed"

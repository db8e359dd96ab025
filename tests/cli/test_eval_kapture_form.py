"""A challenge dataset in its official layout and in kapture folders: one and the same result."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from kapture_forms import aachen_with_kapture
from megloc_twins.aachen import AachenTwin, AachenTwinOptions

NAME = "submissions/Aachen_v1_1_eval_megloc-classic.txt"
SMALL = AachenTwinOptions(
    num_places=1,
    stations_per_place=7,
    sequence_images=2,
    day_queries=4,
    night_queries=1,
    additional_night_queries=1,
    width=480,
    height=360,
)


@pytest.mark.slow
def test_aachen_in_both_forms_gives_the_same_pose_file(
    megloc: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    official = tmp_path / "official"
    AachenTwin(SMALL).write(official)
    downloaded = aachen_with_kapture(official, tmp_path / "downloaded")
    shutil.copytree(official / "ground_truth", downloaded / "ground_truth")
    monkeypatch.chdir(tmp_path)
    options = (
        *("--set", "local_features.options.max_keypoints=1500", "--executor", "inline"),
        *("--set", "global_features.options.num_clusters=16"),
    )
    for root in (official, downloaded):
        done = megloc(
            *("eval", "aachen", "--root", root, "--workspace", tmp_path / f"{root.name}-run"),
            *(*options, "--submissions", "submissions"),
        )
        assert done.status == 0, done.err
        assert f"pose file  {NAME}\n" in done.out
    runs = [tmp_path / f"{root.name}-run" for root in (official, downloaded)]
    # the second was the same, and was left as it was
    assert [path.name for path in sorted((tmp_path / "submissions").iterdir())] == [
        Path(NAME).name,
        f"{Path(NAME).name}.json",
    ]
    assert (runs[0] / NAME).read_bytes() == (runs[1] / NAME).read_bytes()
    rows = (tmp_path / NAME).read_text().splitlines()
    assert len(rows) >= 3 and all("/" not in row.split()[0] for row in rows)
    tables = ("names.csv", "groups.csv", "protocol.json", "world.json")
    for table in tables:
        one, other = ((run / "megloc" / table).read_bytes() for run in runs)
        assert one == other, table
    # and the commands for one result know it by its name
    done = megloc("submit", "aachen", "-i", runs[1] / "localized", "-o", tmp_path / "mine.txt")
    assert (done.status, done.err) == (0, ""), done
    assert (tmp_path / "mine.txt").read_bytes() == (tmp_path / NAME).read_bytes()
    done = megloc("check", "aachen", NAME, "--data", runs[1])
    assert done.status == 0, done.out
    recall = json.loads((runs[1] / "evaluation/recall.json").read_text())
    assert [row["name"] for row in recall["rows"]] == ["day", "night", "all"]
    # what a server might find right is told of, and handed in where that is asked for
    again = (
        *("eval", "aachen", "--root", downloaded, "--workspace", runs[1], "--until", "submission"),
        *options,
    )
    doubted = megloc(*again, "--set", "localization.min_confidence=1")
    kept = len((runs[1] / NAME).read_text().splitlines())
    told = re.search(r"(\d+) poses had too little confidence", doubted.err)
    assert told is not None and kept + int(told[1]) >= len(rows) > kept, doubted.err
    trusted = megloc(*again, "--set", "localization.min_confidence=0")
    assert len((runs[1] / NAME).read_text().splitlines()) >= len(rows)
    assert "too little confidence" not in trusted.err

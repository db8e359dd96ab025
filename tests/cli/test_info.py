"""``megloc info``: content of a map, and the ways to localize in it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.io.kapture import KaptureFolder, write_sensors


def described(out: str) -> dict[str, str]:
    """Return the first column of each line with the rest of the line."""
    return dict(re.findall(r"^(\w[\w ]*?)  +(.*)$", out, re.MULTILINE))


@pytest.mark.parametrize(
    ("given", "images", "origin"),
    [
        ("foreign_map", 7, "corner"),
        pytest.param("virtual_gallery", 12, "centre", marks=pytest.mark.slow),
    ],
)
def test_the_content_and_possible_uses_of_a_foreign_map_are_listed(
    megloc: Any, request: pytest.FixtureRequest, given: str, images: int, origin: str
) -> None:
    place = request.getfixturevalue(given) / "map"
    done = megloc("info", place)
    assert (done.status, done.err) == (0, "")
    listed = described(done.out)
    assert listed["images"] == f"{images} ({images} PINHOLE), {images} with a pose"
    assert listed["points"] == str(len(KaptureFolder(place).points3d()))
    assert listed["pixel origin"].startswith(f"{origin}: ")
    assert listed["map descriptors"] == "present"
    # R2D2 has an extractor, but its weights are missing
    assert listed["query features"].startswith(
        "must be in the query's kapture folder; plugin r2d2 could extract"
    )
    assert "megloc weights fetch r2d2_WASF_N16" in listed["query features"]
    # the few images are all matched; global features of queries need missing weights
    every = f"all {images} map images"
    assert listed["retrieval"] == f"{every}, not ranked"
    ranked = f"if queries have AP-GeM-LM18: {every}, ranked by global features AP-GeM-LM18"
    assert ranked in done.out
    errors = re.search(r"origin: corner ([\d.]+) px, centre ([\d.]+) px", done.out)
    assert errors is not None
    of_other, of_origin = sorted(map(float, errors.groups()), reverse=True)
    assert of_origin < 0.9 * of_other and float(errors[1 + (origin == "centre")]) == of_origin


def test_our_own_map_is_checked_completely_on_demand(megloc: Any, finished: Path) -> None:
    listed = described(megloc("info", finished / "map", "--deep").out)
    assert listed["checked"] == "all files and images: no fault found"
    assert listed["pixel origin"].startswith("corner: ")
    assert listed["query features"].startswith("extracted by plugin rootsift")
    assert listed["map descriptors"] == "present"


def test_a_folder_of_queries_is_no_map_and_may_have_unknown_cameras(
    megloc: Any, scene: Path, tmp_path: Path
) -> None:
    listed = described(megloc("info", scene / "query").out)
    assert listed["images"] == "4 (4 PINHOLE), 0 with a pose"
    assert listed["localizing"] == "not possible: no points3d and observations"
    data = KaptureFolder(scene / "query").read()
    for name, sensor in data.sensors.items():
        data.sensors[name] = replace(sensor, params=("UNKNOWN_CAMERA", *sensor.params[1:3]))
    write_sensors(tmp_path, data)
    listed = described(megloc("info", tmp_path).out)
    assert listed["images"].startswith("4 (4 UNKNOWN_CAMERA)")
    assert listed["missing files"] == f"4 of the images, such as {data.image_names()[0]}"

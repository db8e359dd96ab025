"""Aachen Day-Night's twin: its layout, truth and import, looked at with kapture and COLMAP."""

from __future__ import annotations

from pathlib import Path

LAYOUT = "aachen"

NUM_DATABASE, NUM_SEQUENCE = 30, 6


def listed(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().split("\n")]


def test_quirks_of_the_layout(root: Path) -> None:
    models, queries = root / "3D-models", root / "queries"
    rows = listed(models / "aachen_cvpr2018_db.nvm")
    rows = [row for row in rows if row and row[0].startswith("db/")]
    names = [row[0] for row in rows]
    # numbered without order, the model's order is its own, and so is that of the intrinsics
    numbers = [int(name[3:-4]) for name in names]
    assert numbers != sorted(numbers) and max(numbers) > len(numbers)
    # the NVM's distortion has the other sign
    k = {row[0]: float(row[-1]) for row in listed(models / "database_intrinsics.txt") if row}
    assert set(k) == set(names) and list(k) != names
    assert [float(row[-2]) for row in rows] == [-k[name] for name in names]
    assert any(value != 0 for value in k.values())
    day, night = (
        listed(queries / f"{when}_time_queries_with_intrinsics.txt") for when in ("day", "night")
    )
    assert (len(day), len(night)) == (4, 4)  # no line end, so no empty line, at the end
    assert {len(row) for row in day + night} == {8}
    # the digits the published lists have
    numbers = [float(text) for row in day + night for text in row[4:]]
    assert numbers == [float(f"{number:.6g}") for number in numbers]
    assert {row[1] for row in day} == {"SIMPLE_RADIAL"}
    assert len({tuple(row[2:]) for row in day + night}) == 8  # a camera each
    images = root / "images_upright"
    on_disk = {str(path.relative_to(images)) for path in (images / "query").rglob("*.jpg")}
    in_lists = {row[0] for row in day + night}
    assert in_lists < on_disk and len(on_disk - in_lists) == 2
    assert len({name.split("/")[-1] for name in on_disk}) == len(on_disk)
    assert sum("additional" in row[0] for row in night) == 2

"""Pose files of several runs in one folder: none is overwritten and none is kept twice."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.pose_files import write_provenance
from megloc_kapture.pipeline.submission import keep_submission
from tests.worlds import folder_bytes

NAME = "Aachen_v1_1_eval_megloc-classic"


def pose_file(run: Path, text: str, **provenance: str) -> Path:
    place = run / "submissions" / f"{NAME}.txt"
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(text)
    write_provenance(place, provenance, counts={})
    return place


def pose_files(run: Path, texts: dict[str, str]) -> Path:
    place = run / "submissions" / "4Seasons_eval_megloc-1.5"
    place.mkdir(parents=True)
    for name, text in texts.items():
        (place / name).write_text(text)
    write_provenance(place, {}, counts={}, files=list(texts))
    return place


def test_different_pose_files_get_numbers_and_equal_ones_are_reused(tmp_path: Path) -> None:
    folder, texts = tmp_path / "kept", ("first\n", "second\n", "third\n")
    places = [pose_file(tmp_path / text.strip(), text, preset=text) for text in texts]
    names = [f"{NAME}.txt", f"{NAME}-2.txt", f"{NAME}-3.txt"]
    kept = [keep_submission(place, folder) for place in places]
    assert kept == [folder / name for name in names]
    assert kept[0].with_name(f"{NAME}.txt.json").read_bytes() == (
        places[0].with_name(f"{NAME}.txt.json").read_bytes()
    )
    for place, text in zip(kept, texts, strict=True):
        provenance = json.loads(place.with_name(f"{place.name}.json").read_text())
        assert place.read_text() == text
        assert list(provenance["files"]) == [place.name] and provenance["preset"] == text
    before = folder_bytes(folder)
    # the provenance of the first run stays
    again = pose_file(tmp_path / "again", "second\n", preset="another")
    for place, expected in zip([*reversed(places), again], [*kept[::-1], kept[1]], strict=True):
        assert keep_submission(place, folder) == expected
    assert folder_bytes(folder) == before


def test_a_challenge_of_several_files_is_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "kept"
    first = pose_files(tmp_path / "1", {"a.txt": "1 2\n", "b.txt": "3 4\n"})
    other = pose_files(tmp_path / "2", {"a.txt": "1 2\n", "b.txt": "5 6\n"})
    fewer = pose_files(tmp_path / "3", {"a.txt": "1 2\n"})
    names = [keep_submission(place, folder).name for place in (fewer, first, other, first)]
    assert names == [f"4Seasons_eval_megloc-1.5{end}" for end in ("", "-2", "-3", "-2")]
    for place, name in zip((fewer, first, other), names, strict=False):
        assert folder_bytes(folder / name) == folder_bytes(place)
        assert (folder / f"{name}.json").read_bytes() == Path(f"{place}.json").read_bytes()


def test_a_missing_pose_file_is_refused(tmp_path: Path) -> None:
    place = pose_file(tmp_path / "run", "a\n")
    place.unlink()
    with pytest.raises(DataError, match="--from submission"):
        keep_submission(place, tmp_path / "kept")
    assert not (tmp_path / "kept").exists()

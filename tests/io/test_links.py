"""Images are linked: the links lead to the files themselves, whatever was a link before."""

from __future__ import annotations

from pathlib import Path

import pytest

from megloc_kapture.errors import OutputError
from megloc_kapture.io.links import hard_link, link_file, link_images


@pytest.fixture
def source(tmp_path: Path) -> Path:
    images = tmp_path / "source" / "sensors" / "records_data"
    images.mkdir(parents=True)
    (images / "a.jpg").write_bytes(b"image")
    return tmp_path / "source"


def test_images_and_masks_are_linked(source: Path, tmp_path: Path) -> None:
    (source / "sensors" / "masks").mkdir()
    link_images(source, tmp_path / "new")
    place = tmp_path / "new" / "sensors"
    assert (place / "records_data").readlink() == source / "sensors" / "records_data"
    assert (place / "masks").readlink() == source / "sensors" / "masks"
    assert (place / "records_data" / "a.jpg").read_bytes() == b"image"


def test_what_is_not_there_is_not_linked(tmp_path: Path) -> None:
    (tmp_path / "empty" / "sensors").mkdir(parents=True)
    link_images(tmp_path / "empty", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_link_to_a_link_leads_to_the_end(source: Path, tmp_path: Path) -> None:
    link_images(source, tmp_path / "first")
    link_images(tmp_path / "first", tmp_path / "second")
    link = tmp_path / "second" / "sensors" / "records_data"
    assert link.readlink() == source / "sensors" / "records_data"


def test_a_relative_source_is_found_from_elsewhere(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(source.parent)
    link_images(Path("source"), tmp_path / "far" / "away")
    images = tmp_path / "far" / "away" / "sensors" / "records_data"
    assert (images / "a.jpg").read_bytes() == b"image"


def test_a_link_of_before_is_replaced(source: Path, tmp_path: Path) -> None:
    place = tmp_path / "new" / "sensors" / "records_data"
    place.parent.mkdir(parents=True)
    place.symlink_to(tmp_path / "gone")
    link_images(source, tmp_path / "new")
    assert place.readlink() == source / "sensors" / "records_data"


def test_a_folder_is_not_replaced(source: Path, tmp_path: Path) -> None:
    place = tmp_path / "new" / "sensors" / "records_data"
    place.mkdir(parents=True)
    (place / "b.jpg").write_bytes(b"mine")
    with pytest.raises(OutputError, match="records_data: cannot write: File exists"):
        link_images(source, tmp_path / "new")
    assert (place / "b.jpg").read_bytes() == b"mine"


def test_one_file_is_linked_in_the_place_of_an_older_one(source: Path, tmp_path: Path) -> None:
    image = source / "sensors" / "records_data" / "a.jpg"
    place = tmp_path / "new" / "deep" / "a.jpg"
    place.parent.mkdir(parents=True)
    place.write_bytes(b"older")
    link_file(image, place)
    assert place.readlink() == image
    place.parent.joinpath("file").touch()
    with pytest.raises(OutputError, match="file/a.jpg"):
        link_file(image, place.parent / "file" / "a.jpg")


def test_a_hard_link_is_the_same_file_and_replaces_what_was_there(tmp_path: Path) -> None:
    source, place = tmp_path / "source", tmp_path / "deep" / "place"
    source.write_bytes(b"new")
    for _ in range(2):
        hard_link(source, place)
        assert place.samefile(source)
    with pytest.raises(OutputError, match="below"):
        hard_link(source, source / "below")

"""Names that come from data lead nowhere but below their folder."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.errors import DataError
from megloc_kapture.io.paths import check_component, check_no_escape, safe_join


@pytest.mark.parametrize("name", ["a.jpg", "db/1 2.jpg", "..a/b..", "é/ü.png", "a/...b"])
def test_plain_names_are_joined(name: str) -> None:
    assert safe_join(Path("/root"), name) == Path("/root") / name


@pytest.mark.parametrize(
    "name",
    ["", "/a", "..", "../a", "a/../b", "a/..", ".", "./a", "a//b", "a/", "a\\b", "a\0b", "a\nb"],
)
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(DataError):
        safe_join(Path("/root"), name)


@given(st.text(alphabet=st.sampled_from("./\\a b\0\n\udc80,")))
def test_what_is_accepted_stays_below_the_root(name: str) -> None:
    try:
        path = safe_join(Path("/root"), name)
    except DataError:
        return
    assert path.is_relative_to("/root")
    assert path != Path("/root")
    assert str(path) == f"/root/{name}"  # one file, one name


@pytest.mark.parametrize("name", ["a/b", "a,b", " a", "a ", "..", ""])
def test_type_names_are_single_components(name: str) -> None:
    with pytest.raises(DataError):
        check_component(name)


def test_type_names_may_be_odd() -> None:
    assert check_component("r2d2 500+é(1)") == "r2d2 500+é(1)"


def test_links_may_not_leave_the_root(tmp_path: Path) -> None:
    root = tmp_path / "root"
    (root / "inner").mkdir(parents=True)
    (root / "inner" / "file").touch()
    (tmp_path / "outside").touch()
    (root / "good").symlink_to(root / "inner" / "file")
    (root / "bad").symlink_to(tmp_path / "outside")
    (root / "bad_folder").symlink_to(tmp_path)
    assert check_no_escape(root, root / "good") == root / "good"
    with pytest.raises(DataError, match="bad: .*leaves"):
        check_no_escape(root, root / "bad")
    with pytest.raises(DataError):
        check_no_escape(root, root / "bad_folder" / "outside")


def test_the_root_itself_may_be_a_link_and_share_a_prefix_with_others(tmp_path: Path) -> None:
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "file").touch()
    (tmp_path / "root2").mkdir()
    (tmp_path / "root2" / "file").touch()
    (tmp_path / "link").symlink_to(tmp_path / "root")
    check_no_escape(tmp_path / "link", tmp_path / "link" / "file")
    (tmp_path / "root" / "other").symlink_to(tmp_path / "root2" / "file")
    with pytest.raises(DataError):
        check_no_escape(tmp_path / "root", tmp_path / "root" / "other")


def test_a_name_of_a_thousand_folders_is_refused(tmp_path: Path) -> None:
    """Python makes the parents of a folder one within the other, and gives up."""
    with pytest.raises(DataError, match="path of 1000 folders: 'a/a/a"):
        safe_join(tmp_path, "a/" * 1000 + "x.jpg")

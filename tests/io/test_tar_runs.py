"""Indexing of tars: what reading runs of members at once finds is what ``tarfile`` finds."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from megloc_kapture.errors import DataError
from megloc_kapture.io import blobs
from megloc_kapture.io.blobs import index_tar
from megloc_kapture.io.tar_runs import names_of_run

Member = tuple[str, int, dict[str, Any]]


def make(path: Path, members: list[Member], form: int = tarfile.PAX_FORMAT) -> None:
    with tarfile.open(path, "w", format=form) as tar:
        for name, size, changes in members:
            info = tarfile.TarInfo(name)
            info.size = size
            for key, value in changes.items():
                setattr(info, key, value)
            tar.addfile(info, io.BytesIO(bytes(size)))


def by_tarfile(path: Path) -> dict[str, tuple[int, int]]:
    with tarfile.open(path) as tar:
        return {m.name: (m.offset_data, m.size) for m in tar if m.isreg()}


def alike(count: int, size: int = 700, **changes: Any) -> list[Member]:
    return [(f"a/{k % 3}/{k:04d}.gfeat", size, changes) for k in range(count)]


LONG = "n" * 60 + "/" + "m" * 60
CASES: dict[str, list[Member]] = {
    "plain": alike(60),
    "empty files": alike(40, size=0),
    "whole blocks": alike(40, size=1024),
    "extended by a date": alike(40, mtime=1234567.25),
    "prefix": [(f"{LONG}/{k}.gfeat", 10, {}) for k in range(40)],
    "extended path": [(f"é{k:03d}" + "x" * 250, 10, {}) for k in range(40)],
    "not ascii": [(f"é/{k}.gfeat", 10, {}) for k in range(40)],
    "another size in between": [*alike(30), ("b", 5, {}), *alike(30), ("c", 5, {})],
    "a folder in between": [*alike(30), ("d", 0, {"type": tarfile.DIRTYPE}), *alike(30)],
    "an old kind of file": [*alike(30), ("d", 700, {"type": tarfile.AREGTYPE})],
    "twice": [*alike(30), *alike(30)],
    "as tar names them": [(f"./a/{k}.gfeat", 10, {}) for k in range(40)],
    "extended once": [*alike(20), ("b", 700, {"mtime": 0.5}), *alike(20)],
    "records of a size": [
        (f"s{k}", 700, {"pax_headers": {"size": "700"}, "mtime": 0.5}) for k in range(9)
    ],
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("form", [tarfile.PAX_FORMAT, tarfile.GNU_FORMAT])
def test_the_index_is_tarfile_s(tmp_path: Path, case: str, form: int) -> None:
    path = tmp_path / "x.tar"
    make(path, CASES[case], form)
    expected = {name.removeprefix("./"): place for name, place in by_tarfile(path).items()}
    found, end = index_tar(path)
    assert found == expected
    last = max(offset + size for offset, size in expected.values())
    assert end == -(-last // 512) * 512


def test_members_of_a_run_are_not_met_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    met = 0
    plain = tarfile.TarFile.next

    def counted(self: tarfile.TarFile) -> tarfile.TarInfo | None:
        nonlocal met
        met += 1
        return plain(self)

    monkeypatch.setattr(tarfile.TarFile, "next", counted)
    for case in ("plain", "extended by a date", "prefix", "not ascii"):
        met = 0
        make(tmp_path / "x.tar", CASES[case])
        assert len(index_tar(tmp_path / "x.tar")[0]) == len(CASES[case])
        assert met <= 4, case


@pytest.mark.parametrize("name", ["../a", "/a", "a\\b", "a//b", "a/./b", "a\tb", "a\nb"])
def test_names_in_a_run_are_checked(tmp_path: Path, name: str) -> None:
    make(tmp_path / "x.tar", [*alike(20), (name, 700, {}), *alike(20)])
    with pytest.raises(DataError, match=r"x\.tar"):
        index_tar(tmp_path / "x.tar")


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE])
def test_links_in_a_run_are_refused(tmp_path: Path, kind: bytes) -> None:
    link = ("link", 0, {"type": kind, "linkname": "/etc/passwd"})
    make(tmp_path / "x.tar", [*alike(20, size=0), link, *alike(20, size=0)])
    with pytest.raises(DataError, match="not a plain file"):
        index_tar(tmp_path / "x.tar")


def test_a_global_header_holds_for_all_that_follow(tmp_path: Path) -> None:
    with tarfile.open(
        tmp_path / "x.tar", "w", format=tarfile.PAX_FORMAT, pax_headers={"uname": "somebody"}
    ) as tar:
        for name, size, _ in alike(20):
            info = tarfile.TarInfo(name)
            info.size = size
            tar.addfile(info, io.BytesIO(bytes(size)))
    assert index_tar(tmp_path / "x.tar")[0] == by_tarfile(tmp_path / "x.tar")


@pytest.mark.parametrize("cut", [1, 400, 512, 1000, 1212, 1300, 1535])
def test_a_tar_cut_within_a_run(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "x.tar"
    make(path, alike(40))
    content = path.read_bytes()
    path.write_bytes(content[: 30 * 1536 + cut])
    with pytest.raises(DataError, match=r"x\.tar"):
        index_tar(path)
    found, _ = index_tar(path, repair=True)
    assert len(found) == 30 + (cut >= 1212)


@given(st.integers(0, 512 * 30 - 1), st.integers(0, 255), st.booleans())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
def test_damage_is_met_as_tarfile_alone_meets_it(
    tmp_path: Path, place: int, value: int, extended: bool
) -> None:
    path = tmp_path / "x.tar"
    make(path, alike(10, size=3, mtime=0.5 if extended else 0))
    content = bytearray(path.read_bytes())
    content[place % len(content)] = value
    path.write_bytes(content)

    def outcome() -> object:
        try:
            return index_tar(path)
        except DataError:
            return None

    found = outcome()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blobs, "names_of_run", lambda *_, **__: [])
        assert found == outcome()


def test_nothing_follows(tmp_path: Path) -> None:
    path = tmp_path / "x.tar"
    make(path, alike(2))
    with open(path, "rb") as file:
        total = path.stat().st_size
        args = {"header_bytes": 512, "size": 700}
        assert names_of_run(file.fileno(), 0, total, **args) == [n for n, *_ in alike(2)]
        assert names_of_run(file.fileno(), total, total, **args) == []
        assert names_of_run(file.fileno(), 0, total, header_bytes=1024, size=700) == []

"""The tar form: deterministic, resumable, and safe against broken archives."""

from __future__ import annotations

import io
import re
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.kapture import blobs
from megloc_kapture.io.kapture.blobs import FolderBlobs, TarBlobs, TarBlobWriter, index_tar

CONTENTS = {
    "a.kpt": b"x" * 1000,
    "deep/er/b.kpt": b"",
    "é ü.kpt": b"y" * 512,
    "long/" + "n" * 180 + "/" + "m" * 120 + ".kpt": b"z",
}


def write(path: Path, contents: dict[str, bytes]) -> bytes:
    writer = TarBlobWriter(path)
    for name, content in contents.items():
        writer.write(name, content)
    writer.close()
    return path.read_bytes()


Member = tuple[str, int, dict[str, Any]]


def make(path: Path, members: list[Member], form: int = tarfile.PAX_FORMAT, **how: Any) -> None:
    """A tar by tarfile: names, sizes, and what else is set of each member."""
    with tarfile.open(path, how.pop("mode", "w"), format=form, **how) as tar:
        for name, size, changes in members:
            info = tarfile.TarInfo(name)
            info.size = size
            for key, value in changes.items():
                setattr(info, key, value)
            tar.addfile(info, io.BytesIO(bytes(size)))


def alike(count: int, size: int = 700, **changes: Any) -> list[Member]:
    return [(f"a/{k % 3}/{k:04d}.gfeat", size, changes) for k in range(count)]


def test_tar_members_come_back_and_tarfile_agrees(tmp_path: Path) -> None:
    path = tmp_path / "x.tar"
    write(path, CONTENTS)
    blobs = TarBlobs(tmp_path, path, ".kpt")
    assert blobs.names() == sorted(CONTENTS)
    assert TarBlobs(tmp_path, path, ".desc").names() == []
    for name, content in CONTENTS.items():
        assert blobs.read(name) == content
        assert blobs.size(name) == len(content)
    with tarfile.open(path) as tar:
        assert {m.name: tar.extractfile(m).read() for m in tar} == CONTENTS  # type: ignore[union-attr]
        assert {(m.mtime, m.uid, m.gid, m.uname, m.mode) for m in tar} == {(0, 0, 0, "", 0o644)}


def test_writing_goes_on_where_it_stopped(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.tar", CONTENTS)
    path = tmp_path / "parts.tar"
    for name, content in CONTENTS.items():
        writer = TarBlobWriter(path)
        assert name not in writer
        writer.write(name, content)
        assert name in writer
        writer.close()
    assert path.read_bytes() == whole


@pytest.mark.parametrize("cut", [1, 100, 511, 512, 513, 1024, 1500, 1536, 1537, 2048, 4000, 9000])
def test_a_killed_run_loses_one_member_at_most(tmp_path: Path, cut: int) -> None:
    whole = write(tmp_path / "whole.tar", CONTENTS)
    path = tmp_path / "cut.tar"
    path.write_bytes(whole[:cut])
    if cut < 512:
        with pytest.raises(DataError):  # not even a header: not known to be ours
            TarBlobWriter(path)
        return
    writer = TarBlobWriter(path)
    complete = {
        n for n, (at, size) in index_tar(tmp_path / "whole.tar")[0].items() if at + size <= cut
    }
    assert {name for name in CONTENTS if name in writer} == complete
    for name, content in CONTENTS.items():
        if name not in writer:
            writer.write(name, content)
    writer.close()
    assert path.read_bytes() == whole


def test_an_empty_or_unfinished_file_is_an_empty_tar(tmp_path: Path) -> None:
    path = tmp_path / "x.tar"
    path.touch()
    assert TarBlobs(tmp_path, path, ".kpt").names() == []
    tarfile.open(tmp_path / "y.tar", "w").close()
    assert TarBlobs(tmp_path, tmp_path / "y.tar", ".kpt").names() == []
    # a member whose header was not written yet is written again
    (tmp_path / "z.tar").write_bytes(bytes(512) + b"content")
    for name in ("x.tar", "y.tar", "z.tar"):
        write(tmp_path / name, {"a.kpt": b"old"})
        write(tmp_path / name, {"a.kpt": b"newer"})  # the last of a name counts
        blobs = TarBlobs(tmp_path, tmp_path / name, ".kpt")
        assert blobs.names() == ["a.kpt"] and blobs.read("a.kpt") == b"newer"
    with pytest.raises(OutputError, match=r"x\.tar/below\.tar"):
        TarBlobWriter(tmp_path / "x.tar" / "below.tar")


DANGEROUS: list[tuple[str, dict[str, Any], str]] = [
    ("../a.kpt", {}, "leads out"),
    ("/a.kpt", {}, "absolute"),
    *((name, {}, "") for name in ("a\\b", "a//b", "a/./b", "a\tb", "a\nb")),
    ("a.kpt", {"type": tarfile.SYMTYPE, "linkname": "/etc/passwd"}, "not a plain file"),
    ("a.kpt", {"type": tarfile.LNKTYPE, "linkname": "a"}, "not a plain file"),
    ("a.kpt", {"type": tarfile.CHRTYPE}, "not a plain file"),
]


@pytest.mark.parametrize("others", [0, 20], ids=["alone", "in a run"])
@pytest.mark.parametrize(("name", "changes", "match"), DANGEROUS)
def test_dangerous_members_are_refused(
    tmp_path: Path, name: str, changes: dict[str, Any], match: str, others: int
) -> None:
    path, run = tmp_path / "x.tar", alike(others, size=0)
    make(path, [*run, (name, 0 if changes else 4, changes), *run])
    with pytest.raises(DataError, match=f"x.tar: .*{match}"):
        TarBlobs(tmp_path, path, ".kpt")
    with pytest.raises(DataError):  # nor is such a tar cut down to what we know
        TarBlobWriter(path)


def test_compressed_and_truncated_tars_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.tar"
    make(path, alike(1), mode="w:gz")
    with pytest.raises(DataError, match=r"x\.tar: not a readable"):
        TarBlobs(tmp_path, path, ".kpt")
    whole = write(tmp_path / "whole.tar", {"a.kpt": bytes(1000), "b.kpt": bytes(1000)})
    for cut in (600, 1100, 1537, 1800, 2100, 3000):
        path.write_bytes(whole[:cut])
        with pytest.raises(DataError, match=r"x\.tar: "):
            TarBlobs(tmp_path, path, ".kpt")
    path.write_bytes(whole[:1536] + b"garbage" * 100)
    with pytest.raises(DataError, match=r"x\.tar: "):
        TarBlobs(tmp_path, path, ".kpt")


LOOP = """
import sys
from pathlib import Path
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.blobs import index_tar
try:
    index_tar(Path(sys.argv[1]))
except DataError as error:
    print(error)
"""


@pytest.mark.parametrize("start", [0, 1024])
def test_a_negative_size_does_not_loop(tmp_path: Path, start: int) -> None:
    path = tmp_path / "x.tar"
    whole = bytearray(write(path, {"a.kpt": b"1234", "b.kpt": b"1234"}))
    header = whole[start : start + 512]
    header[124:136] = b"\xff" * 10 + b"\xfe\x00"  # base-256: -512, back to this header
    header[148:156] = b" " * 8
    header[148:156] = f"{sum(header):06o}\0 ".encode()
    path.write_bytes(whole[:start] + header + whole[start + 512 :])
    # in a process of its own: without the guard this would never end
    command = [sys.executable, "-c", LOOP, str(path)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    # tarfile says it since Python 3.14 itself, in words of its own
    assert re.search(r"x\.tar: .*(broken|invalid offset)", run.stdout)


def test_links_in_folders_may_not_lead_out(tmp_path: Path) -> None:
    folder = tmp_path / "root" / "T"
    folder.mkdir(parents=True)
    (tmp_path / "secret.kpt").write_bytes(b"1234")
    blobs = FolderBlobs(tmp_path / "root", folder, ".kpt")
    for link, target, name in (
        (folder / "a.kpt", tmp_path / "secret.kpt", "a.kpt"),
        (folder / "sub", tmp_path, "sub/secret.kpt"),
    ):
        link.symlink_to(target)
        with pytest.raises(DataError, match=f"{link.name}: .*link"):
            blobs.names()
        with pytest.raises(DataError, match=r"\.kpt: .*link"):
            blobs.read(name)
        link.unlink()
    (tmp_path / "root" / "linked").symlink_to(tmp_path)
    with pytest.raises(DataError, match="linked: .*link"):
        FolderBlobs(tmp_path / "root", tmp_path / "root" / "linked", ".kpt")


def by_tarfile(path: Path) -> dict[str, tuple[int, int]]:
    with tarfile.open(path) as tar:
        return {m.name: (m.offset_data, m.size) for m in tar if m.isreg()}


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


def test_plain_members_are_not_met_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    met: list[tarfile.TarFile] = []
    plain = tarfile.TarFile.next
    monkeypatch.setattr(tarfile.TarFile, "next", lambda tar: met.append(tar) or plain(tar))
    for case in ("plain", "empty files"):
        make(tmp_path / "x.tar", CASES[case])
        met.clear()
        assert len(index_tar(tmp_path / "x.tar")[0]) == len(CASES[case])
        assert len(met) <= 3, case


def test_a_global_header_holds_for_all_that_follow(tmp_path: Path) -> None:
    make(tmp_path / "x.tar", alike(20), pax_headers={"uname": "somebody"})
    assert index_tar(tmp_path / "x.tar")[0] == by_tarfile(tmp_path / "x.tar")


@given(st.integers(0, 512 * 30 - 1), st.integers(0, 255), st.booleans())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
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
        patch.setattr(blobs, "_plain_members", lambda *_: [])
        assert found == outcome()


@pytest.mark.parametrize("size", [str(2**62), str(2**63), "9" * 30])
@pytest.mark.parametrize("form", ["of a member", "of all"])
def test_a_pax_header_of_a_huge_size_is_refused(tmp_path: Path, size: str, form: str) -> None:
    path = tmp_path / "keypoints.tar"
    headers = {"size": size}
    of_all = headers if form == "of all" else {}
    with tarfile.open(path, "w", format=tarfile.PAX_FORMAT, pax_headers=of_all) as tar:
        member = tarfile.TarInfo("a.kpt")
        member.pax_headers = {} if of_all else headers
        tar.addfile(member)
        tar.addfile(tarfile.TarInfo("b.kpt"))
    with pytest.raises(DataError, match="keypoints.tar: "):
        index_tar(path)
    # the length of the header itself
    content = path.read_bytes()
    with tarfile.open(path, "w") as tar:
        header = tarfile.TarInfo("././@PaxHeader")
        header.type, header.size = tarfile.XHDTYPE, 2**50
        tar.fileobj.write(header.tobuf(tarfile.GNU_FORMAT) + content[512:])  # type: ignore[union-attr]
    with pytest.raises(DataError, match="keypoints.tar: "):
        index_tar(path)

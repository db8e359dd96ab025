"""The tar form: deterministic, resumable, and safe against broken archives."""

from __future__ import annotations

import io
import pickle
import re
import subprocess
import sys
import tarfile
from concurrent.futures import ThreadPoolExecutor
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


def test_tar_members_come_back_and_tarfile_agrees(tmp_path: Path) -> None:
    path = tmp_path / "x.tar"
    write(path, CONTENTS)
    blobs = TarBlobs(tmp_path, path, ".kpt")
    assert blobs.names() == sorted(CONTENTS)
    for name, content in CONTENTS.items():
        assert blobs.read(name) == content
        assert blobs.size(name) == len(content)
    with tarfile.open(path) as tar:
        assert {m.name: tar.extractfile(m).read() for m in tar} == CONTENTS  # type: ignore[union-attr]
        assert {(m.mtime, m.uid, m.gid, m.uname, m.mode) for m in tar} == {(0, 0, 0, "", 0o644)}


def test_equal_content_gives_equal_bytes(tmp_path: Path) -> None:
    assert write(tmp_path / "a.tar", CONTENTS) == write(tmp_path / "b.tar", CONTENTS)


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


def test_an_unfinished_first_member_is_written_again(tmp_path: Path) -> None:
    path = tmp_path / "x.tar"
    path.write_bytes(bytes(512) + b"content of a member whose header was not written yet")
    assert write(path, CONTENTS) == write(tmp_path / "y.tar", CONTENTS)


def test_the_last_member_of_a_name_counts(tmp_path: Path) -> None:
    path = tmp_path / "x.tar"
    write(path, {"a.kpt": b"old"})
    write(path, {"a.kpt": b"newer"})
    assert TarBlobs(tmp_path, path, ".kpt").read("a.kpt") == b"newer"


def test_an_empty_file_is_an_empty_tar(tmp_path: Path) -> None:
    path = tmp_path / "x.tar"
    path.touch()
    assert TarBlobs(tmp_path, path, ".kpt").names() == []
    tarfile.open(tmp_path / "y.tar", "w").close()
    assert TarBlobs(tmp_path, tmp_path / "y.tar", ".kpt").names() == []
    for name in ("x.tar", "y.tar"):
        write(tmp_path / name, {"a.kpt": b"x"})
        assert TarBlobs(tmp_path, tmp_path / name, ".kpt").names() == ["a.kpt"]


def add(path: Path, mode: str = "w", **changes: object) -> None:
    with tarfile.open(path, mode) as tar:  # type: ignore[call-overload]
        info = tarfile.TarInfo("a.kpt")
        info.size = 4
        for name, value in changes.items():
            setattr(info, name, value)
        tar.addfile(info, io.BytesIO(b"1234"))


def test_tars_made_by_others_are_read(tmp_path: Path) -> None:
    (tmp_path / "in" / "sub").mkdir(parents=True)
    (tmp_path / "in" / "sub" / "a.kpt").write_bytes(b"1234")
    (tmp_path / "in" / "other.txt").touch()
    with tarfile.open(tmp_path / "x.tar", "w", format=tarfile.GNU_FORMAT) as tar:
        tar.add(tmp_path / "in", arcname=".")  # "./sub/a.kpt" and folders
    blobs = TarBlobs(tmp_path, tmp_path / "x.tar", ".kpt")
    assert blobs.names() == ["sub/a.kpt"]
    assert blobs.read("sub/a.kpt") == b"1234"


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"name": "../a.kpt"}, "leads out"),
        ({"name": "/a.kpt"}, "absolute"),
        ({"name": "a\\b.kpt"}, "backslash"),
        ({"type": tarfile.SYMTYPE, "linkname": "/etc/passwd"}, "not a plain file"),
        ({"type": tarfile.LNKTYPE, "linkname": "a"}, "not a plain file"),
        ({"type": tarfile.CHRTYPE}, "not a plain file"),
    ],
)
def test_dangerous_members_are_refused(
    tmp_path: Path, changes: dict[str, object], match: str
) -> None:
    path = tmp_path / "x.tar"
    add(path, **changes)
    with pytest.raises(DataError, match=f"x.tar: .*{match}"):
        TarBlobs(tmp_path, path, ".kpt")
    with pytest.raises(DataError):  # nor is such a tar cut down to what we know
        TarBlobWriter(path)


def test_compressed_and_truncated_tars_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.tar"
    add(path, "w:gz")
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
    run = subprocess.run(
        [sys.executable, "-c", LOOP, str(path)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    # tarfile says it since Python 3.14 itself, in words of its own
    assert re.search(r"x\.tar: .*(broken|invalid offset)", run.stdout)


def test_readers_work_in_threads_and_other_processes(tmp_path: Path) -> None:
    contents = {f"{i}.kpt": bytes([i]) * (i * 37) for i in range(100)}
    write(tmp_path / "x.tar", contents)
    blobs = TarBlobs(tmp_path, tmp_path / "x.tar", ".kpt")
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(blobs.read, contents)) == list(contents.values())
    assert pickle.loads(pickle.dumps(blobs)).read("7.kpt") == contents["7.kpt"]


def test_an_impossible_place_is_an_output_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"file/x\.tar"):
        TarBlobWriter(tmp_path / "file" / "x.tar")


def test_links_in_folders_may_not_lead_out(tmp_path: Path) -> None:
    folder = tmp_path / "root" / "T"
    folder.mkdir(parents=True)
    (tmp_path / "secret.kpt").write_bytes(b"1234")
    (folder / "a.kpt").symlink_to(tmp_path / "secret.kpt")
    blobs = FolderBlobs(tmp_path / "root", folder, ".kpt")
    with pytest.raises(DataError, match=r"a\.kpt: .*link"):
        blobs.names()
    with pytest.raises(DataError, match=r"a\.kpt: .*link"):
        blobs.read("a.kpt")
    (folder / "a.kpt").unlink()
    (folder / "sub").symlink_to(tmp_path)
    with pytest.raises(DataError, match="sub: .*link"):
        blobs.names()
    with pytest.raises(DataError, match="link"):
        blobs.read("sub/secret.kpt")
    (tmp_path / "root" / "linked").symlink_to(tmp_path)
    with pytest.raises(DataError, match="linked: .*link"):
        FolderBlobs(tmp_path / "root", tmp_path / "root" / "linked", ".kpt")


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


def test_plain_members_are_not_met_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    met = 0
    plain = tarfile.TarFile.next

    def counted(self: tarfile.TarFile) -> tarfile.TarInfo | None:
        nonlocal met
        met += 1
        return plain(self)

    monkeypatch.setattr(tarfile.TarFile, "next", counted)
    for case in ("plain", "empty files"):
        met = 0
        make(tmp_path / "x.tar", CASES[case])
        assert len(index_tar(tmp_path / "x.tar")[0]) == len(CASES[case])
        assert met <= 3, case


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

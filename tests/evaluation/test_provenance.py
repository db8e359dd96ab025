"""The JSON beside a pose file."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.provenance import package_versions, write_provenance


def test_holds_what_was_given_and_binds_the_file(tmp_path: Path) -> None:
    import numpy

    pose_file = tmp_path / "aachen.txt"
    pose_file.write_text("a.jpg 1 0 0 0 0 0 0\n")
    options = {"preset": "classic", "options": {"max_error_px": 8.0}}
    path = write_provenance(pose_file, options, counts={"queries": 2, "poses": 1})
    assert path == tmp_path / "aachen.txt.json"
    content = json.loads(path.read_text())
    assert content["files"] == {"aachen.txt": hashlib.sha256(pose_file.read_bytes()).hexdigest()}
    assert content["counts"] == {"queries": 2, "poses": 1}
    assert content["preset"] == "classic"
    assert content["options"] == {"max_error_px": 8.0}
    assert content["versions"] == package_versions()
    assert package_versions()["numpy"] == numpy.__version__
    first = path.read_bytes()
    again = write_provenance(pose_file, options, counts={"queries": 2, "poses": 1})
    assert again.read_bytes() == first


def test_several_files_of_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "mlad"
    (folder / "sub").mkdir(parents=True)
    (folder / "b.txt").write_text("b")
    (folder / "sub" / "a.txt").write_text("a")
    (folder / "older.txt").write_text("of another run")
    path = write_provenance(folder, {}, counts={}, files=["sub/a.txt", "b.txt"])
    assert path == tmp_path / "mlad.json"
    assert json.loads(path.read_text())["files"] == {
        "b.txt": hashlib.sha256(b"b").hexdigest(),
        "sub/a.txt": hashlib.sha256(b"a").hexdigest(),
    }


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot read"):
        write_provenance(tmp_path / "absent.txt", {}, counts={})
    (tmp_path / "poses.txt").write_text("")
    with pytest.raises(ValueError, match="already ours: files"):
        write_provenance(tmp_path / "poses.txt", {"files": ""}, counts={})
    with pytest.raises(ValueError, match="JSON"):
        write_provenance(tmp_path / "poses.txt", {"x": float("nan")}, counts={})
    assert not (tmp_path / "poses.txt.json").exists()

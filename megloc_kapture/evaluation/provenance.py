"""Provenance of a pose file, kept beside it: versions, options, counts; no dates."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import read_json_model, write_json

# what can change a pose or a figure of the report
_PACKAGES = (
    "megloc-kapture",
    "numpy",
    "scipy",
    "opencv-python-headless",
    "pycolmap",
    "poselib",
    "torch",
    "matplotlib",
)


def installed_version(package: str) -> str | None:
    """Installed version of a package, None where it is absent."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def package_versions() -> dict[str, str]:
    """Package -> installed version, for those that are installed."""
    found = ((package, installed_version(package)) for package in _PACKAGES)
    return {package: version for package, version in found if version is not None}


def provenance_path(target: Path | str) -> Path:
    """Path of the provenance: ``x.txt.json`` of a file ``x.txt``, ``x.json`` of a folder ``x``."""
    path = Path(target)
    return path.with_name(f"{path.name}.json")


def write_provenance(
    target: Path | str,
    provenance: Mapping[str, Any],
    *,
    counts: Mapping[str, int],
    files: Sequence[str] | None = None,
) -> Path:
    """Write the provenance of a pose file that has been written; returns its path.

    The JSON holds the SHA-256 of each file, so that they can be told to belong together, the
    package versions, ``counts`` and the entries of ``provenance`` (options, preset, inputs). It
    holds no date and no duration: the same run gives the same bytes.

    Parameters
    ----------
    target : the pose file, or the folder of a challenge that takes several.
    files : names of the pose files below the folder ``target``; None: it is a file.

    Raises
    ------
    DataError : a pose file cannot be read.
    ValueError : an entry of ``provenance`` would replace one of ours, or is not JSON.
    OutputError : the file cannot be written.
    """
    target = Path(target)
    paths = {target.name: target} if files is None else {name: target / name for name in files}
    ours: dict[str, Any] = {
        "files": {name: _sha256(path) for name, path in sorted(paths.items())},
        "versions": package_versions(),
        "counts": dict(counts),
    }
    taken = sorted(ours.keys() & provenance.keys())
    if taken:
        raise ValueError(f"provenance entries are already ours: {', '.join(taken)}")
    path = provenance_path(target)
    write_json(path, ours | dict(provenance))
    return path


class _Scores(BaseModel):
    confidence: dict[str, Annotated[float, Field(ge=0, le=1)]] = {}


def read_confidences(target: Path | str) -> dict[str, float]:
    """Image -> confidence of its pose, as the provenance beside a pose file has it under
    ``confidence``; empty where there is none. DataError: it is broken, or has something else."""
    path = provenance_path(target)
    return read_json_model(path, _Scores).confidence if path.is_file() else {}


def _sha256(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror or error}", path=path) from error

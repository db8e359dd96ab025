"""Where a pose file comes from, kept beside it: versions, options, counts; no dates."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from megloc_kapture.errors import DataError
from megloc_kapture.io.json_model import write_json

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


def provenance_path(pose_file: Path | str) -> Path:
    """The provenance of ``poses.txt`` is ``poses.txt.json``."""
    path = Path(pose_file)
    return path.with_name(f"{path.name}.json")


def write_provenance(
    pose_file: Path | str, provenance: Mapping[str, Any], *, counts: Mapping[str, int]
) -> Path:
    """Write the provenance of a pose file that has been written; returns its path.

    The JSON holds the SHA-256 of the pose file, so that the two can be told to belong together,
    the package versions, ``counts`` and the entries of ``provenance`` (options, preset, inputs).
    It holds no date and no duration: the same run gives the same bytes.

    Raises
    ------
    DataError : the pose file cannot be read.
    ValueError : an entry of ``provenance`` would replace one of ours, or is not JSON.
    OutputError : the file cannot be written.
    """
    pose_file = Path(pose_file)
    try:
        content = pose_file.read_bytes()
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror or error}", path=pose_file) from error
    ours: dict[str, Any] = {
        "pose_file": pose_file.name,
        "sha256": hashlib.sha256(content).hexdigest(),
        "versions": package_versions(),
        "counts": dict(counts),
    }
    taken = sorted(ours.keys() & provenance.keys())
    if taken:
        raise ValueError(f"provenance entries are already ours: {', '.join(taken)}")
    path = provenance_path(pose_file)
    write_json(path, ours | dict(provenance))
    return path

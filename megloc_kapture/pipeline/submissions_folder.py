"""The folder in which the pose files of all runs are kept, none of them ever overwritten."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from itertools import count
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.provenance import provenance_path
from megloc_kapture.io.files import write_bytes, write_json

FOLDER = "submissions"


def keep_submission(place: Path, folder: Path) -> Path:
    """Copy a submission and its provenance into a folder, beside those of other runs.

    The same bytes are left as they are. Where another result bears the name already, it stays,
    and the new one gets a number: ``Aachen_eval_METHOD-2.txt``.

    Parameters
    ----------
    place : the pose file, or the folder of a challenge that takes several; its provenance lies
        beside it.
    folder : where to; made where it is missing.

    Returns
    -------
    Where the copy stands.

    Raises
    ------
    DataError : the submission or its provenance is missing or cannot be read.
    OutputError : the copy cannot be written.
    """
    content = _content(place)
    beside = _read(provenance_path(place))
    kept = next(other for other in _places(place, folder) if _is_free(other, content))
    there = _content(kept) if os.path.lexists(kept) else {}
    for name in content.keys() - there.keys():
        write_bytes(kept / name if name else kept, content[name])
    # last: with its provenance a submission is whole
    if there != content or not os.path.lexists(provenance_path(kept)):
        _write_provenance(place, beside, kept)
    return kept


def _places(place: Path, folder: Path) -> Iterator[Path]:
    """The names a copy may have, in the order they are tried."""
    # only a file's name has a type: that of a folder may hold a dot
    end = place.suffix if place.is_file() else ""
    stem = place.name.removesuffix(end)
    yield folder / place.name
    for number in count(2):
        yield folder / f"{stem}-{number}{end}"


def _content(place: Path) -> dict[str, bytes]:
    """Bytes by name below ``place``; the name is "" where it is a file itself."""
    if not place.is_dir():
        return {"": _read(place)}
    try:
        files = sorted(place.iterdir())
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror or error}", path=place) from error
    return {file.name: _read(file) for file in files}


def _is_free(place: Path, content: dict[str, bytes]) -> bool:
    """Whether nothing stands there but the same, or that part of it which a killed run wrote."""
    if not os.path.lexists(place):
        return True
    try:
        there = _content(place)
    except DataError:  # a folder in it, a dangling link: whatever it is, it is not this
        return False
    if os.path.lexists(provenance_path(place)):
        return there == content
    return there.items() <= content.items()


def _read(path: Path) -> bytes:
    if not path.is_file():
        raise DataError("no such file; --from submission writes it again", path=path)
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror or error}", path=path) from error


def _write_provenance(place: Path, beside: bytes, kept: Path) -> None:
    if kept.name == place.name or place.is_dir():
        write_bytes(provenance_path(kept), beside)
        return
    # it names the file it belongs to
    try:
        told = json.loads(beside)
        told["files"] = {kept.name: told["files"][place.name]}
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"not the provenance of {place.name}; --from submission writes it again",
            path=provenance_path(place),
        ) from error
    write_json(provenance_path(kept), told)

"""Keypoints, descriptors and global features of images, and the files that hold them.

Features, one binary array per image, are stored in a kapture folder (``reconstruction/<kind>/T/``)
or in kapture-localization's orphan layout (``local_features/T/<kind>/``,
``global_features/T/global_features/``), as files or as a single tar. The folder name ``T`` is the
type name; ``name`` in the configuration file is not used. Arrays are raw, little-endian, row-major,
without a header.
"""

from __future__ import annotations

import os
import re
import tarfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import DataError, OutputError, require
from megloc_kapture.io.files import (
    check_component,
    check_relative,
    hard_link,
    named,
    reading,
    safe_join,
    write_bytes,
)
from megloc_kapture.io.kapture.format import check_columns, format_table, read_rows

FeatureKind = Literal["keypoints", "descriptors", "global_features", "matches"]
ArrayKind = Literal["keypoints", "descriptors", "global_features"]

SUFFIX: dict[str, str] = {
    "keypoints": ".kpt",
    "descriptors": ".desc",
    "global_features": ".gfeat",
    "matches": ".matches",
}
CONFIG_HEADER: dict[str, str] = {
    "keypoints": "# name, dtype, dsize",
    "descriptors": "# name, dtype, dsize, keypoints_type, metric_type",
    "global_features": "# name, dtype, dsize, metric_type",
}
# the only names accepted here; kapture evaluates the text as Python
DTYPES: dict[str, np.dtype[Any]] = {
    name: np.dtype(code)
    for name, code in (("float32", "<f4"), ("float64", "<f8"), ("int32", "<i4"), ("uint8", "u1"))
}
_ROUNDING = 4e-7  # rows whose squared length differs from 1 by at most this stay unchanged


@dataclass(frozen=True)
class FeatureConfig:
    """The only row of a ``keypoints.txt``, ``descriptors.txt`` or ``global_features.txt``.

    ``dsize`` is the number of values per row; ``metric_type`` is the distance, e.g. ``"L2"``.
    """

    name: str
    dtype: np.dtype[Any]
    dsize: int
    keypoints_type: str | None = None
    metric_type: str | None = None

    def __post_init__(self) -> None:
        dtype = np.dtype(self.dtype).newbyteorder("<")
        require(dtype in DTYPES.values(), f"dtype {dtype.name!r} is not one of {', '.join(DTYPES)}")
        object.__setattr__(self, "dtype", dtype)


def feature_folder(root: Path, kind: FeatureKind, type_name: str, *, orphan: bool) -> Path:
    parent = _types_folder(root, kind, orphan) / check_component(type_name)
    return parent / kind if orphan else parent


def features_dir_hint(kind: FeatureKind) -> str:
    place = feature_folder(Path("FOLDER"), kind, "TYPE", orphan=True)
    return f"--features-dir FOLDER adds those in {place}"


def has_features(root: Path, kind: ArrayKind, type_name: str, image: str) -> bool:
    """Return whether an image has a feature file (not in a tar) in the orphan layout."""
    folder = feature_folder(root, kind, type_name, orphan=True)
    return (folder / f"{check_relative(image)}{SUFFIX[kind]}").is_file()


def _types_folder(root: Path, kind: FeatureKind, orphan: bool) -> Path:
    if not orphan:
        return Path(root) / "reconstruction" / kind
    return Path(root) / ("global_features" if kind == "global_features" else "local_features")


def list_types(root: Path, kind: FeatureKind, *, orphan: bool) -> list[str]:
    """List the type names of one kind in a kapture or features folder, sorted."""
    parent = _types_folder(root, kind, orphan)
    if not parent.is_dir():
        return []
    if (parent / f"{kind}.txt").is_file():
        message = "upgrade features of kapture 1.0 with kapture_upgrade_1_0_to_1_1"
        if orphan:
            message = f"give the folder that contains {parent.name}/TYPE/{kind}"
        raise DataError(f"the features lack the folder of their type: {message}", path=parent)
    types = []
    with reading(parent):
        names = sorted(entry.name for entry in parent.iterdir() if not entry.name.startswith("."))
    for name in names:
        folder = parent / name / kind if orphan else parent / name
        if folder.is_dir() if kind == "matches" else (folder / f"{kind}.txt").is_file():
            with named(parent):
                types.append(check_component(name))
    return types


def read_config(path: Path, kind: ArrayKind) -> FeatureConfig:
    with read_rows(path) as rows:
        for fields in rows:
            check_columns(fields, CONFIG_HEADER[kind].count(",") + 1)
            name, dtype, dsize, *rest = fields
            require(dtype in DTYPES, f"dtype {dtype!r} is not one of {', '.join(DTYPES)}")
            if not re.fullmatch("[0-9]{1,9}", dsize) or int(dsize) == 0:
                raise DataError(f"dsize {dsize!r} is not a positive integer")
            keypoints_type = check_component(rest[0]) if kind == "descriptors" else None
            metric_type = rest[-1] if rest else None
            return FeatureConfig(name, DTYPES[dtype], int(dsize), keypoints_type, metric_type)
    raise DataError("the row with the configuration is missing", path=path)


def format_config(kind: ArrayKind, config: FeatureConfig) -> bytes:
    row = [config.name, config.dtype.name, str(config.dsize)]
    if kind == "descriptors":
        row.append(check_component(config.keypoints_type or ""))
    if kind != "keypoints":
        row.append(config.metric_type or "L2")
    return format_table(CONFIG_HEADER[kind], [row])


# ------------------------------------------------------------------------------------ files


class Blob(NamedTuple):
    """The array of an image or pair: a file, or a member of a tar."""

    name: str
    path: str
    offset: int  # 0 in a file
    size: int

    def read(self) -> bytes:
        with reading(self.path), open(self.path, "rb", buffering=0) as file:
            content = os.pread(file.fileno(), self.size, self.offset)
        require(len(content) == self.size, "the file is truncated", path=self.where)
        return content

    @property
    def where(self) -> str:
        return f"{self.path}[{self.name}]" if self.offset else self.path


# folders of a type, each with the members of its tar by name
BlobFolders = Mapping[Path, Mapping[str, Blob]]


def open_folders(folders: Sequence[Path], kind: FeatureKind) -> BlobFolders:
    return {folder: _tar_members(folder / f"{kind}.tar", SUFFIX[kind]) for folder in folders}


def _tar_members(path: Path, suffix: str) -> dict[str, Blob]:
    """List the members of an uncompressed tar, kapture's form for many files, if it exists."""
    if not path.is_file() or path.stat().st_size == 0:
        return {}  # kapture creates a tar as an empty file
    members = {}
    with reading(path, "an uncompressed tar"), named(path), tarfile.open(path, "r:") as tar:
        for member in tar:
            if member.isreg() and member.name.endswith(suffix):
                name = check_relative(member.name.removeprefix("./"))
                members[name] = Blob(name, str(path), member.offset_data, member.size)
    return members


def list_blobs(folders: BlobFolders, kind: FeatureKind) -> dict[str, str]:
    """Return the path of each blob by name."""
    paths: dict[str, str] = {}
    for root, members in folders.items():
        paths |= {name: blob.where for name, blob in members.items()}
        for folder, _, files in os.walk(root):
            below = f"{folder}/".removeprefix(f"{root}/")
            paths |= {below + n: f"{folder}/{n}" for n in files if n.endswith(SUFFIX[kind])}
    return paths


def find_blob(folders: BlobFolders, *names: str) -> Blob | None:
    """Return the blob with one of the names from the first folder that has it, or None."""
    for folder, members in folders.items():
        for name in names:
            if name in members:
                return members[name]
            path = f"{folder}/{check_relative(name)}"  # creating a Path is much slower
            try:
                size = os.stat(path).st_size
            except OSError:
                continue
            return Blob(name, path, 0, size)
    return None


# --------------------------------------------------------------------------------- reading


class FeatureReader:
    """Features of one kind and type; thread-safe.

    The array of an image is read from the first folder that has it.
    """

    def __init__(self, kind: ArrayKind, type_name: str, folders: Sequence[Path]) -> None:
        self.kind, self.type_name = kind, type_name
        self._folders = open_folders(folders, kind)
        paths = [folder / f"{kind}.txt" for folder in folders]
        self.config, *others = [read_config(path, kind) for path in paths]
        for path, config in zip(paths[1:], others, strict=True):
            require(
                (config.dtype, config.dsize) == (self.config.dtype, self.config.dsize),
                f"rows are {config.dsize} x {config.dtype.name}, but in {paths[0]} "
                f"they are {self.config.dsize} x {self.config.dtype.name}",
                path=path,
            )

    @cached_property
    def names(self) -> list[str]:
        names = list_blobs(self._folders, self.kind)
        return sorted(name.removesuffix(SUFFIX[self.kind]) for name in names)

    def __contains__(self, image: str) -> bool:
        return find_blob(self._folders, image + SUFFIX[self.kind]) is not None

    def length(self, image: str) -> int:
        """Return the number of rows of an image's array, from the file size."""
        return self._num_rows(self._blob(image))

    def read(self, image: str) -> NDArray[Any]:
        """Read an image's array, (N, dsize) or (dsize,) for global features; finite, writable."""
        blob = self._blob(image)
        rows = self._num_rows(blob)
        array = np.frombuffer(blob.read(), dtype=self.config.dtype)
        require(np.isfinite(array).all(), "not all values are finite", path=blob.where)
        shape = (-1,) if self.kind == "global_features" else (rows, self.config.dsize)
        return array.reshape(shape).copy()

    def where(self, image: str) -> str:
        return self._blob(image).where

    def _num_rows(self, blob: Blob) -> int:
        rows, rest = divmod(blob.size, self.config.dsize * self.config.dtype.itemsize)
        if rest or (self.kind == "global_features" and rows != 1):
            expected = "exactly one row" if self.kind == "global_features" else "whole rows"
            raise DataError(
                f"{blob.size} bytes are not {expected} of "
                f"{self.config.dsize} x {self.config.dtype.name}; truncated?",
                path=blob.where,
            )
        return rows

    def _blob(self, image: str) -> Blob:
        blob = find_blob(self._folders, image + SUFFIX[self.kind])
        if blob is None:
            raise DataError(f"no {self.kind} of type {self.type_name!r} for image {image!r}")
        return blob


class KaptureVectors:
    """Global features of images, normalised to unit length and read in blocks of rows.

    Nothing is cached. Zero rows stay zero.
    """

    def __init__(self, reader: FeatureReader, images: Sequence[str]) -> None:
        self._reader = reader
        self._images = images

    @property
    def shape(self) -> tuple[int, int]:
        return len(self._images), self._reader.config.dsize

    def __getitem__(self, part: slice) -> NDArray[np.float32]:
        """Read the unit rows of a part of the images, (N, D)."""
        images = self._images[part]
        rows = np.empty((len(images), self.shape[1]), np.float32)
        for row, image in zip(rows, images, strict=True):
            row[:] = self._reader.read(image)
        squared = np.einsum("ij,ij->i", rows, rows, dtype=np.float64)
        scaled = np.flatnonzero((squared > 0) & (np.abs(squared - 1) > _ROUNDING))
        rows[scaled] /= np.sqrt(squared[scaled])[:, None]
        return rows


# --------------------------------------------------------------------------------- writing


class FeatureWriter:
    """Writer for the features of one kind and type.

    Each file is written atomically. A stopped run can resume with the same configuration:
    ``image in writer`` is True if the image's file exists.
    """

    def __init__(
        self,
        root: Path,
        kind: ArrayKind,
        type_name: str,
        config: FeatureConfig,
        *,
        orphan: bool = False,
    ) -> None:
        self.kind, self.config = kind, config
        self._folder = feature_folder(Path(root), kind, type_name, orphan=orphan)
        path = self._folder / f"{kind}.txt"
        content = format_config(kind, config)
        if not path.exists():
            write_bytes(path, content)
        elif format_config(kind, read_config(path, kind)) != content:
            raise OutputError(f"{path}: has a different configuration; remove its folder first")

    def __contains__(self, image: str) -> bool:
        return self._path(image).is_file()

    def write(self, image: str, array: ArrayLike) -> None:
        """Write an image's array, (N, dsize) or (dsize,)."""
        given, dtype = np.asarray(array), self.config.dtype
        require(
            given.size == 0 or np.can_cast(given.dtype, dtype, "same_kind"),
            f"image {image}: {given.dtype}, but {dtype} in the {self.kind} of other images",
        )
        content = np.ascontiguousarray(given, dtype=dtype)
        require(
            content.size == 0 or content.shape[-1] == self.config.dsize,
            f"image {image}: {content.shape[-1]} columns, but {self.config.dsize} in the "
            f"{self.kind} of other images",
        )
        write_bytes(self._path(image), content.tobytes())

    def copy(self, image: str, source: FeatureReader, *, link: bool = True) -> None:
        """Copy an image's array; with ``link``, hard-link its file if it is not in a tar."""
        file = Path(source.where(image))
        if link and file.is_file():
            hard_link(file, self._path(image))
        else:
            self.write(image, source.read(image))

    def _path(self, image: str) -> Path:
        return safe_join(self._folder, image + SUFFIX[self.kind])

"""Keypoints, descriptors and global features: one binary array per image.

They lie inside a kapture (``reconstruction/<kind>/T/``) or in kapture-localization's orphan
layout (``local_features/T/<kind>/``, ``global_features/T/global_features/``), as files or as one
tar. ``T``, the folder's name, is the type name by which they are found; the ``name`` written
inside the configuration file may differ and means nothing here.

Arrays are raw, little-endian, row-major, without a header: only the size of a file can be checked
against its configuration.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import (
    Roots,
    check_component,
    check_no_escape,
    check_output,
    check_relative,
    named,
    safe_join,
    write_bytes,
)
from megloc_kapture.io.kapture.blobs import BlobSource, FolderBlobs, TarBlobs, TarBlobWriter
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
# the four names kapture knows; it evaluates the text, we look it up
DTYPES: dict[str, np.dtype[Any]] = {
    name: np.dtype(code)
    for name, code in (("float32", "<f4"), ("float64", "<f8"), ("int32", "<i4"), ("uint8", "u1"))
}


@dataclass(frozen=True)
class FeatureConfig:
    """The row of one ``keypoints.txt``, ``descriptors.txt`` or ``global_features.txt``.

    Parameters
    ----------
    name : of the method; free text.
    dtype : float32, float64, int32 or uint8.
    dsize : numbers per keypoint, or the length of a descriptor.
    keypoints_type : descriptors only: the type (folder) of the keypoints they belong to.
    metric_type : descriptors and global features: how to compare them, e.g. ``"L2"``.
    """

    name: str
    dtype: np.dtype[Any]
    dsize: int
    keypoints_type: str | None = None
    metric_type: str | None = None

    def __post_init__(self) -> None:
        dtype = np.dtype(self.dtype)
        if dtype.newbyteorder("<") not in DTYPES.values():
            raise DataError(f"dtype {dtype.name!r} is not one of {', '.join(DTYPES)}")
        if self.dsize < 1:
            raise DataError(f"dsize {self.dsize} is not positive")
        object.__setattr__(self, "dtype", dtype.newbyteorder("<"))
        object.__setattr__(self, "dsize", int(self.dsize))

    @property
    def row_bytes(self) -> int:
        return self.dsize * self.dtype.itemsize


def feature_folder(root: Path, kind: FeatureKind, type_name: str, *, orphan: bool) -> Path:
    """The folder of one type, inside a kapture or below a features folder (``orphan``).

    Raises DataError where the type name cannot be the name of a folder.
    """
    parent = _types_folder(root, kind, orphan) / check_component(type_name)
    return parent / kind if orphan else parent


def _types_folder(root: Path, kind: FeatureKind, orphan: bool) -> Path:
    if not orphan:
        return Path(root) / "reconstruction" / kind
    return Path(root) / ("global_features" if kind == "global_features" else "local_features")


def list_types(root: Path, kind: FeatureKind, *, orphan: bool) -> list[str]:
    """Type names of one kind that a kapture or features folder holds, sorted."""
    parent = _types_folder(root, kind, orphan)
    try:
        names = sorted(entry.name for entry in parent.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror}", path=parent) from error
    found = []
    for name in names:
        if name.startswith("."):
            continue
        folder = parent / name / kind if orphan else parent / name
        present = folder.is_dir() if kind == "matches" else (folder / f"{kind}.txt").is_file()
        if present:
            with named(parent):
                found.append(check_component(name))
    return found


def read_config(path: Path, kind: ArrayKind) -> FeatureConfig:
    """Read one configuration file; DataError names file and line."""
    with read_rows(path) as rows:
        found = list(rows)
    if len(found) != 1:
        raise DataError(f"expected one row, got {len(found)}", path=path)
    line, fields = found[0]
    with named(path, line):
        check_columns(fields, CONFIG_HEADER[kind].count(",") + 1)
        name, dtype, dsize, *rest = fields
        if dtype not in DTYPES:
            raise DataError(f"dtype {dtype!r} is not one of {', '.join(DTYPES)}")
        if not re.fullmatch("[0-9]{1,9}", dsize) or int(dsize) == 0:
            raise DataError(f"dsize {dsize!r} is not a positive integer")
        keypoints_type = check_component(rest[0]) if kind == "descriptors" else None
    metric_type = rest[-1] if rest else None
    return FeatureConfig(name, DTYPES[dtype], int(dsize), keypoints_type, metric_type)


def format_config(kind: ArrayKind, config: FeatureConfig) -> bytes:
    """The bytes of a configuration file."""
    row = [config.name, config.dtype.name, str(config.dsize)]
    if kind == "descriptors":
        if config.keypoints_type is None:
            raise DataError("descriptors need the type of their keypoints (keypoints_type)")
        row.append(check_component(config.keypoints_type))
    if kind != "keypoints":
        row.append(config.metric_type or "L2")
    return format_table(CONFIG_HEADER[kind], [row])


def blob_sources(roots: Roots, folder: Path, kind: FeatureKind) -> list[BlobSource]:
    """The tar of a type's folder, where there is one, before its loose files."""
    sources: list[BlobSource] = [FolderBlobs(roots, folder, SUFFIX[kind])]
    tar = folder / f"{kind}.tar"
    return [TarBlobs(roots, tar, SUFFIX[kind]), *sources] if tar.is_file() else sources


class FeatureReader:
    """The features of one kind and type, from one or several folders.

    Where several folders hold an image, the first counts. Reading is safe from many threads.

    Attributes
    ----------
    config : dtype and size of the arrays.
    sources : the blobs of the folders, in order.
    """

    def __init__(
        self, kind: ArrayKind, type_name: str, folders: Sequence[tuple[Roots, Path]]
    ) -> None:
        """``folders``: (roots that links may not leave, folder of the type), in order.

        Raises DataError: a broken configuration, or folders whose dtypes or sizes differ.
        """
        self.kind, self.type_name = kind, type_name
        self.sources: list[BlobSource] = []
        configs: list[tuple[Path, FeatureConfig]] = []
        for roots, folder in folders:
            path = check_no_escape(roots, folder / f"{kind}.txt")
            configs.append((path, read_config(path, kind)))
            self.sources += blob_sources(roots, folder, kind)
        first_path, self.config = configs[0]
        for path, config in configs[1:]:
            if (config.dtype, config.dsize) != (self.config.dtype, self.config.dsize):
                raise DataError(
                    f"{config.dsize} x {config.dtype.name}, but {first_path} "
                    f"has {self.config.dsize} x {self.config.dtype.name}",
                    path=path,
                )
        self._names: list[str] | None = None

    @property
    def names(self) -> list[str]:
        """Images that have these features, sorted."""
        if self._names is None:
            cut = len(SUFFIX[self.kind])
            self._names = sorted({n[:-cut] for s in self.sources for n in s.names()})
        return list(self._names)

    def __contains__(self, image: object) -> bool:
        return isinstance(image, str) and self._find(image) is not None

    def length(self, image: str) -> int:
        """Number of rows of an image, from the size of its file alone; raises as `read` does."""
        source, name = self._source(image)
        return self.num_rows(source, name, source.size(name))

    def read(self, image: str) -> NDArray[Any]:
        """The array of an image, (N, dsize); (dsize,) for global features. Writable.

        Raises DataError: no features of that image, a truncated file, or values that are not
        finite.
        """
        source, name = self._source(image)
        content = source.read(name)
        rows = self.num_rows(source, name, len(content))
        array = np.frombuffer(content, dtype=self.config.dtype)
        if not np.isfinite(array).all():
            raise DataError("not all values are finite", path=source.where(name))
        if self.kind == "global_features":
            return array
        return array.reshape(rows, self.config.dsize)

    def where(self, image: str) -> str:
        """The file (or member of a tar) that holds an image's array, for messages."""
        source, name = self._source(image)
        return source.where(name)

    def num_rows(self, source: BlobSource, name: str, size: int) -> int:
        """Rows of an array of so many bytes; DataError where it is cut, or no global feature."""
        rows, rest = divmod(size, self.config.row_bytes)
        if rest or (self.kind == "global_features" and rows != 1):
            expected = "exactly one row" if self.kind == "global_features" else "whole rows"
            raise DataError(
                f"{size} bytes are not {expected} of "
                f"{self.config.dsize} x {self.config.dtype.name}; truncated?",
                path=source.where(name),
            )
        return rows

    def _find(self, image: str) -> tuple[BlobSource, str] | None:
        name = image + SUFFIX[self.kind]
        return next(((source, name) for source in self.sources if name in source), None)

    def _source(self, image: str) -> tuple[BlobSource, str]:
        found = self._find(image)
        if found is None:
            raise DataError(f"no {self.kind} of type {self.type_name!r} for image {image!r}")
        return found


class BlobWriter:
    """Writes blobs below a folder, each atomically as a file, or into its ``STEM.tar``."""

    def __init__(self, folder: Path, stem: str, *, tar: bool) -> None:
        self._folder = folder
        self._tar = TarBlobWriter(folder / f"{stem}.tar") if tar else None

    def has(self, name: str) -> bool:
        """True where a blob is written already."""
        if self._tar is not None:
            return name in self._tar
        try:
            return safe_join(self._folder, name).is_file()
        except OSError:
            return False  # too long a name, or a folder closed to us: writing will say so

    def put(self, name: str, content: bytes) -> Path:
        """Write one; returns the file that holds it."""
        if self._tar is not None:
            return self._tar.write(name, content)
        path = safe_join(self._folder, name)
        write_bytes(path, content)
        return path

    def close(self) -> None:
        """Finish the tar; the writer is of no use afterwards."""
        if self._tar is not None:
            self._tar.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class FeatureWriter(BlobWriter):
    """Write the features of one kind and type; each image's file is atomic.

    Opening writes the configuration, or checks that the one there is the same, so that a stopped
    run can go on: ``image in writer`` tells what is written already. Use as a context manager.
    """

    def __init__(
        self,
        root: Path,
        kind: ArrayKind,
        type_name: str,
        config: FeatureConfig,
        *,
        tar: bool = False,
        orphan: bool = False,
    ) -> None:
        """Raises DataError for a name or configuration that kapture cannot hold, OutputError where
        it cannot be written or another configuration stands there.
        """
        self.kind, self.type_name, self.config = kind, type_name, config
        folder = feature_folder(Path(root), kind, type_name, orphan=orphan)
        check_output(Path(root), folder)
        self._path = path = folder / f"{kind}.txt"
        content = format_config(kind, config)
        if path.exists():
            if format_config(kind, read_config(path, kind)) != content:
                raise OutputError(f"{path}: holds another configuration; remove its folder first")
        else:
            write_bytes(path, content)
        super().__init__(folder, kind, tar=tar)

    def __contains__(self, image: str) -> bool:
        return self.has(image + SUFFIX[self.kind])

    def write(self, image: str, array: ArrayLike) -> tuple[Path, Path]:
        """Write one image's array, (N, dsize), or (dsize,) for global features.

        Returns the files that say what it is and hold it.

        Raises
        ------
        ValueError : another shape, or a dtype that the configuration's cannot take over.
        DataError : the image's name is no plain relative path.
        OutputError : cannot be written.
        """
        given = np.asarray(array)
        shape = given.shape
        dsize = self.config.dsize
        if self.kind == "global_features":
            if shape not in ((dsize,), (1, dsize)):
                raise ValueError(f"expected shape ({dsize},), got {shape}")
        elif len(shape) != 2 or shape[1] != dsize:
            raise ValueError(f"expected shape (N, {dsize}), got {shape}")
        if not np.can_cast(given.dtype, self.config.dtype, casting="same_kind"):
            raise ValueError(f"cannot store {given.dtype} as {self.config.dtype.name}")
        content = np.ascontiguousarray(given, dtype=self.config.dtype).tobytes()
        return self._path, self.put(check_field(image) + SUFFIX[self.kind], content)


def check_field(image: str) -> str:
    """Return an image name that is a plain path and can stand in a CSV field, else raise."""
    check_relative(image)
    if "," in image or image != image.strip():
        raise DataError(f"image name {image!r} has a comma or a space at its end")
    return image

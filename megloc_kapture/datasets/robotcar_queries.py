"""The queries of RobotCar Seasons: their locations, and which of them version 2 counts."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.datasets.grammars.robotcar_files import (
    ImageKey,
    read_query_location,
    read_test_list,
    read_train_poses,
)
from megloc_kapture.datasets.official import Missing
from megloc_kapture.datasets.robotcar_layout import CAMERAS, SCORED_CAMERA, Layout
from megloc_kapture.errors import DataError
from megloc_kapture.values import RigidTransform


@dataclass(frozen=True, eq=False)
class Queries:
    """What the lists say.

    Parameters
    ----------
    locations : query -> the locations that list it, in the order of the lists.
    train : rear image -> its published pose, in the order of the list.
    test : rear image -> its name in the pose file, in the order of the list.
    unlisted : how many images of version 2's lists no location lists; only where missing data was
        allowed.
    """

    locations: Mapping[ImageKey, tuple[str, ...]]
    train: Mapping[ImageKey, RigidTransform]
    test: Mapping[ImageKey, str]
    unlisted: int


def read_queries(layout: Layout, version: int, missing: Missing, *, allow_missing: bool) -> Queries:
    """Read the lists of queries of a version; those of version 2 are read wherever they are.

    Raises
    ------
    DataError : a broken list; two images of one camera and time; an image of version 2 that no
        location lists, unless missing data is allowed. Names file and line.
    """
    lists = layout.query_lists()
    if not lists:
        missing.files.append(layout.query_list("001"))
    locations: dict[ImageKey, tuple[str, ...]] = {}
    at_time: dict[tuple[str, int], ImageKey] = {}
    for location, path in lists.items():
        for entry in read_query_location(path):
            note_query(entry.image, at_time, path, entry.line)
            others = locations.get(entry.image, ())
            if location not in others:
                locations[entry.image] = (*others, location)
    train: dict[ImageKey, RigidTransform] = {}
    test: dict[ImageKey, str] = {}
    unlisted = 0
    if _wanted(layout.train_list, version, missing):
        for pose in read_train_poses(layout.train_list):
            image = pose.image
            known = _scored_query(image, at_time, layout.train_list, pose.line, allow_missing)
            unlisted += known is None
            if known is not None:
                train[known] = pose.cam_from_world
    if version == 2 and missing.require(layout.test_list):
        test, more = read_test_names(layout.test_list, at_time, train, allow_missing=allow_missing)
        unlisted += more
    return Queries(locations, train, test, unlisted)


def read_test_names(
    path: Path,
    at_time: Mapping[tuple[str, int], ImageKey],
    train: Collection[ImageKey],
    *,
    allow_missing: bool,
) -> tuple[dict[ImageKey, str], int]:
    """Read version 2's list of test images.

    Parameters
    ----------
    at_time : (camera, time) -> query; the list leaves conditions out.
    train : queries whose poses are public, which are in another list.

    Returns
    -------
    Query -> its text in the list, in its order, and how many of the list are no queries.

    Raises
    ------
    DataError : a broken list, a training image in it, or one that is no query, unless missing
        data is allowed; names the line.
    """
    test: dict[ImageKey, str] = {}
    unlisted = 0
    for entry in read_test_list(path):
        known = _scored_query(entry.image, at_time, path, entry.line, allow_missing)
        unlisted += known is None
        if known in train:
            raise DataError(f"{entry.text!r} is a training image too", path=path, line=entry.line)
        if known is not None:
            test[known] = entry.text
    return test, unlisted


def _wanted(path: Path, version: int, missing: Missing) -> bool:
    """Version 1 is the better for the public poses, but does not need them."""
    return missing.require(path) if version == 2 else path.is_file()


def note_query(
    image: ImageKey, at_time: dict[tuple[str, int], ImageKey], path: Path, line: int | None = None
) -> None:
    """Note the camera and time of a query in ``at_time``.

    Raises
    ------
    DataError : an unknown camera, or another image has its camera and time; names ``path``.
    """
    if image.camera not in CAMERAS:
        raise DataError(
            f"{image.path} is of camera {image.camera!r}; known: {', '.join(CAMERAS)}",
            path=path,
            line=line,
        )
    other = at_time.setdefault((image.camera, image.timestamp), image)
    if other != image:
        raise DataError(
            f"{image.path} and {other.path} are of one camera and time", path=path, line=line
        )


def _scored_query(
    image: ImageKey,
    at_time: Mapping[tuple[str, int], ImageKey],
    path: Path,
    line: int,
    allow_missing: bool,
) -> ImageKey | None:
    """The query an image of version 2's lists is; a list may leave out its condition."""
    if image.camera != SCORED_CAMERA:
        raise DataError(
            f"an image of camera {image.camera!r}, expected {SCORED_CAMERA!r} only",
            path=path,
            line=line,
        )
    found = at_time.get((image.camera, image.timestamp))
    if found is not None and image.condition in ("", found.condition):
        return found
    if allow_missing:
        return None
    raise DataError(
        f"{image.camera}/{image.stem} is in no list of queries_per_location; "
        "--allow-missing leaves it out",
        path=path,
        line=line,
    )

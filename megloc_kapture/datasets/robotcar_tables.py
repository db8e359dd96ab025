"""What kapture cannot say about RobotCar Seasons: conditions, locations, the pose file's rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from megloc_kapture.datasets.official import Count
from megloc_kapture.datasets.robotcar_layout import (
    CAMERAS,
    NUM_LOCATIONS,
    NUM_QUERIES,
    NUM_REFERENCE_IMAGES,
    NUM_REGISTERED,
    NUM_TEST,
    NUM_TRAIN,
    QUERIES_PER_CAMERA,
    SCORED_CAMERA,
    Layout,
)
from megloc_kapture.datasets.robotcar_selection import Selection
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.side_tables import ImageGroup, Protocol


def image_groups(selection: Selection) -> dict[str, ImageGroup]:
    """Condition and location of all images, and which queries are scored."""
    places = selection.queries.locations
    groups = {}
    for image, path in selection.map_images.items():
        location = _location(image.camera, selection.reference.locations.get(image))
        groups[path] = ImageGroup(condition=image.condition, location=location, scored=False)
    for image, path in (*selection.train_images.items(), *selection.query_images.items()):
        groups[path] = ImageGroup(
            condition=image.condition,
            location=_location(image.camera, places[image][0]),
            scored=image in selection.query_images and selection.is_scored(image),
        )
    return groups


def query_priors(
    selection: Selection, groups: Mapping[str, ImageGroup]
) -> dict[str, tuple[str, ...]]:
    """Whom a query may be matched with: map images of its location and camera.

    Map images whose location is not known are permitted to all queries of their camera. Where
    the map has nothing of the kind, the query's own location stands there all the same: it may
    not be matched with others.
    """
    map_paths = (*selection.map_images.values(), *selection.train_images.values())
    known = {groups[path].location for path in map_paths}
    priors = {}
    for image, path in selection.query_images.items():
        own = tuple(_location(image.camera, p) for p in selection.queries.locations[image])
        priors[path] = tuple(name for name in (*own, image.camera) if name in known) or own
    return priors


def pose_file_names(selection: Selection) -> dict[str, str]:
    """Rows of the pose file, in the order of the list: the images the server scores."""
    paths = selection.query_images
    if selection.version == 2:
        names = selection.queries.test
        return {paths[image]: name for image, name in names.items() if image in paths}
    return {
        path: f"{image.camera}/{image.stem}.jpg"
        for image, path in paths.items()
        if image.camera == SCORED_CAMERA
    }


def protocol(dataset: str, version: int) -> Protocol:
    """How the benchmark is scored."""
    public = "The true poses of version 2's training images are public (robotcar_v2_train.txt)"
    others = "test images" if version == 2 else "other queries"
    return protocol_of(dataset).model_copy(
        update={
            "truth": f"{public}; those of the {others} are kept by visuallocalization.net, which "
            "scores the rear camera only."
        }
    )


def summary(selection: Selection, *, reference_images: int) -> list[Count]:
    """What models and lists say, beside what is published, and what of it is imported.

    Parameters
    ----------
    reference_images : how many are on disk, with a pose or without.
    """
    queries, reference = selection.queries, selection.reference
    locations = {location for listed in queries.locations.values() for location in listed}
    counts = [
        Count("locations with queries", len(locations), NUM_LOCATIONS),
        Count("reference images", reference_images, NUM_REFERENCE_IMAGES),
        Count("reference images with a pose", len(reference.poses), NUM_REGISTERED),
        Count("query images", len(queries.locations), NUM_QUERIES),
    ]
    found = Counter((image.condition, image.camera) for image in queries.locations)
    others = sorted({condition for condition, _ in found} - set(QUERIES_PER_CAMERA))
    for condition in (*QUERIES_PER_CAMERA, *others):
        published = QUERIES_PER_CAMERA.get(condition)
        for camera in CAMERAS:
            counts.append(Count(f"  {condition}, {camera}", found[condition, camera], published))
    if selection.version == 2:
        counts.append(Count("training images with a pose", len(queries.train), NUM_TRAIN))
        counts.append(Count("test images", len(queries.test), NUM_TEST))
    map_images = len(selection.map_images) + len(selection.train_images)
    counts.append(Count("map images imported", map_images))
    counts.append(Count("query images imported", len(selection.query_images)))
    return counts


def remarks(selection: Selection) -> list[str]:
    """What a user should know about this import."""
    said = [
        "The rig is the one that the reference model's poses show, as extrinsics/ does not agree "
        "well with them; where the model has fewer than ten moments of all cameras, it is that of "
        "extrinsics/. Every map image has the model's pose, none goes through the rig."
    ]
    unknown = sum(image not in selection.reference.locations for image in selection.map_images)
    if unknown:
        folder = Layout(Path()).individual_model("NNN")
        said.append(
            f"The location of {unknown} map images is not known: only the individual models tell "
            f"it ({folder}, extracted). All queries of their camera may be matched with them."
        )
    if selection.queries.unlisted:
        said.append(
            f"{selection.queries.unlisted} images of version 2's lists are in no list of "
            "queries_per_location and are left out."
        )
    return said


def _location(camera: str, place: str | None) -> str:
    return camera if place is None else f"{place}/{camera}"

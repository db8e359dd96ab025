"""Aachen Day-Night as kapture distributes it: ``mapping/`` and ``query/``, or the queries by day
and at night apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from megloc_kapture.datasets.aachen.layout import (
    ADDITIONAL_NIGHT,
    DAY,
    NIGHT,
    SEQUENCES_FOLDER,
    MapImage,
    QueryImage,
    Version,
)
from megloc_kapture.datasets.kapture_folders import MAPPING, QUERY
from megloc_kapture.datasets.kapture_form import (
    KaptureImage,
    input_files,
    is_kapture,
    kapture_parent,
    read_images,
)
from megloc_kapture.datasets.official import Missing
from megloc_kapture.errors import DataError, OptionError

_QUERY_PARTS = {DAY: "query_day", NIGHT: "query_night"}
# in the folder kapture's archives unpack to
_NAME_OF_V1_1 = ("v1.1", "v1_1", "v11")


@dataclass(frozen=True, slots=True)
class KaptureLayout:
    """Aachen's kapture folders below ``root``."""

    root: Path

    @classmethod
    def find(cls, root: Path) -> KaptureLayout | None:
        """The folders below ``root``; None where there are none."""
        parent = kapture_parent(root)
        return None if parent is None else cls(parent)

    def parts(self) -> list[Path]:
        """The kapture folders that are there: the map's, then the queries'."""
        return [path for path in (self.root / MAPPING, *self._queries()) if is_kapture(path)]

    def input_files(self) -> Iterator[Path]:
        """Every file an import may depend on."""
        yield from input_files(self.parts())

    def read(
        self, wanted: Literal["auto", "1.0", "1.1"], missing: Missing
    ) -> tuple[Version, list[KaptureImage], list[KaptureImage]]:
        """The version, the map's images, and the queries.

        Raises
        ------
        DataError : a broken kapture folder.
        OptionError : v1.0 is wanted, and this is v1.1, whose poses are others.
        """
        mapping = read_images(self.root / MAPPING, missing)
        queries: list[KaptureImage] = []
        for folder in self._queries():
            if missing.require(folder / "sensors" / "sensors.txt"):
                queries += read_images(folder, missing)
        return self._version(wanted, [*mapping, *queries]), mapping, queries

    def _queries(self) -> list[Path]:
        parts = [self.root / name for name in _QUERY_PARTS.values()]
        whole = self.root / QUERY
        # kapture's own scripts merge the two and leave them there
        return [whole] if is_kapture(whole) or not any(map(is_kapture, parts)) else parts

    def _version(
        self, wanted: Literal["auto", "1.0", "1.1"], images: Sequence[KaptureImage]
    ) -> Version:
        names = (image.name for image in images)
        is_newer = any(
            name.startswith((f"{SEQUENCES_FOLDER}/", ADDITIONAL_NIGHT)) for name in names
        )
        if wanted == "1.0" and is_newer:
            raise OptionError(
                f"version=1.0 is wanted, and {self.root} is v1.1, whose poses are others"
            )
        if wanted != "auto":
            return wanted
        path = self.root.resolve()
        folders = (path.name.lower(), path.parent.name.lower())
        named = any(text in name for text in _NAME_OF_V1_1 for name in folders)
        return "1.1" if is_newer or named else "1.0"


def map_images(images: Sequence[KaptureImage]) -> dict[int, MapImage]:
    """The images that have a pose, by their positions in time: their order in the model."""
    cameras: dict[str, int] = {}
    found = {}
    for position, image in enumerate(images):
        if image.cam_from_world is not None:
            camera_id = cameras.setdefault(image.sensor_id, len(cameras))
            found[position] = MapImage(image.name, camera_id, image.camera, image.cam_from_world)
    return found


def query_images(images: Sequence[KaptureImage], root: Path) -> list[QueryImage]:
    """The queries, day first; of each condition the order in time is that of the official list.

    Raises
    ------
    DataError : a name that says neither day nor night.
    """
    by_condition: dict[str, list[KaptureImage]] = {DAY: [], NIGHT: []}
    for image in images:
        folders = image.name.split("/")[:-1]
        condition = next((part for part in folders if part in by_condition), None)
        if condition is None:
            raise DataError(
                f"query {image.name!r} has neither {DAY}/ nor {NIGHT}/ in its name", path=root
            )
        by_condition[condition].append(image)
    return [
        QueryImage(image.name, condition, position, image.camera)
        for condition, of_condition in by_condition.items()
        for position, image in enumerate(of_condition)
    ]

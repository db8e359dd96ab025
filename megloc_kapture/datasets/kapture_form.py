"""Challenge datasets as distributed by kapture: an archive per part, official image names."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from megloc_kapture.datasets.kapture_folders import check_image_size, is_kapture
from megloc_kapture.datasets.official import Missing
from megloc_kapture.errors import OptionError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import Camera, RigidTransform

# kapture's guide to converting Aachen puts the folders next to the official files
_PARENTS = (".", "kapture")
_FOLDERS = ("mapping", "query_day", "query_night", "query")
_FOLDERS_OF_LOCATIONS = ("[0-9][0-9]/mapping", "[0-9][0-9]/query")


@dataclass(frozen=True, slots=True)
class KaptureImage:
    """An image with its kapture data; ``locations`` are ``001`` and so on."""

    name: str
    file: Path
    timestamp: int
    sensor_id: str
    camera: Camera
    cam_from_world: RigidTransform | None
    is_query: bool
    locations: tuple[str, ...]


@dataclass(frozen=True)
class KaptureForm:
    """The kapture folders of a dataset, the map's first."""

    root: Path
    folders: tuple[Path, ...]

    @classmethod
    def find(cls, root: Path, *, with_locations: bool = False) -> KaptureForm | None:
        """Find the folders below a root; return None without a map."""
        patterns = _FOLDERS_OF_LOCATIONS if with_locations else _FOLDERS
        for parent in (Path(root) / name for name in _PARENTS):
            found = [
                [one for one in sorted(parent.glob(pattern)) if is_kapture(one)]
                for pattern in patterns
            ]
            if found[0]:
                return cls(parent, tuple(one for folders in found for one in folders))
        return None

    def read(self, missing: Missing) -> list[KaptureImage]:
        """Read the existing images by folder and time; check one image size per camera."""
        images: dict[str, KaptureImage] = {}
        for path in self.folders:
            folder = KaptureFolder(path)
            data = folder.read()
            number = path.parent.name
            locations = (f"{int(number):03d}",) if number.isdecimal() else ()
            checked: set[str] = set()
            for (timestamp, sensor_id), name in sorted(data.records_camera.items()):
                if (known := images.get(name)) is not None:
                    both = tuple(dict.fromkeys((*known.locations, *locations)))
                    images[name] = replace(known, locations=both)
                    continue
                file, camera = folder.image_path(name), data.camera_of(name)
                if not missing.require(file):
                    continue
                if sensor_id not in checked:
                    check_image_size(file, camera)
                    checked.add(sensor_id)
                pose = data.device_from_world(timestamp, sensor_id)
                images[name] = KaptureImage(
                    name,
                    file,
                    timestamp,
                    sensor_id,
                    camera,
                    pose,
                    path.name != "mapping",
                    locations,
                )
        return list(images.values())

    def rig(self) -> dict[str, RigidTransform]:
        """Return ``sensor_from_rig`` by sensor id; the first folder wins."""
        found: dict[str, RigidTransform] = {}
        for path in self.folders:
            for members in KaptureFolder(path).read().rigs.values():
                found = {**members, **found}
        return found

    def without_model(self) -> OptionError:
        return OptionError(
            f"the reference model is read from the official layout, and {self.root} has kapture "
            "folders; megloc localize localizes in a kapture map"
        )

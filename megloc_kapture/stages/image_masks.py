"""The masks of a kapture's images, from wherever they come, and how they are combined.

Everything that is ignored by one source is ignored: masks are combined by AND.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.plugins import PluginChoice
from megloc_kapture.preprocessing.masks import FixedMask, UnchangingRegion
from megloc_kapture.stages.local_features import mask_path, read_mask
from megloc_kapture.values import Camera, Options

Mask = NDArray[np.bool_]


class MaskOptions(Options):
    """Where masks come from beside those that the kapture has; by default from nowhere."""

    segmenter: PluginChoice | None = Field(
        default=None, description="network that names the class of each pixel"
    )
    dynamic: tuple[str, ...] | None = Field(
        default=None, description="classes to ignore; unset: those the segmenter names itself"
    )
    fixed: tuple[FixedMask, ...] = Field(
        default=(), description="what stands still in all images of a camera"
    )
    unchanging: bool = Field(
        default=False,
        description="find the region at the bottom that never changes, per camera: the bonnet",
    )
    user_masks: Path | None = Field(
        default=None, description="folder of masks IMAGE.png, 0 where the image is ignored"
    )

    def idle(self) -> dict[str, str]:
        return {} if self.segmenter else {"dynamic": "no segmenter tells classes apart"}


@dataclass(frozen=True)
class MaskFiles:
    """The mask files of one image, by source; none where there are none."""

    own: Path | None
    user: Path | None

    def read(self, shape: tuple[int, ...]) -> dict[str, Mask]:
        """The masks bool (H, W), True = use.

        Raises
        ------
        DataError : one is no image, or not of the image's size.
        """
        found = {}
        for source, path in (("own", self.own), ("user", self.user)):
            mask = None if path is None else read_mask(path, shape)
            if mask is not None:
                found[source] = mask
        return found


def mask_files(
    folder: KaptureFolder, images: Iterable[str], user_masks: Path | None
) -> dict[str, MaskFiles]:
    """The mask files that there are, by image.

    Raises
    ------
    DataError : the user's folder is not there, or has a mask of none of the images.
    """
    if user_masks is not None and not user_masks.is_dir():
        raise DataError("no such folder of masks", path=user_masks)
    found = {}
    some = False
    for image in images:
        own = mask_path(folder, image)
        user = None if user_masks is None else user_masks / f"{image}.png"
        own_file = own if own.is_file() else None
        user_file = user if user is not None and user.is_file() else None
        some = some or user_file is not None
        found[image] = MaskFiles(own_file, user_file)
    if user_masks is not None and not some:
        example = next(iter(found), "a/b.jpg")
        raise DataError(
            f"no mask of any image in it; that of {example} is looked for as {example}.png",
            path=user_masks,
        )
    return found


class StandingMasks:
    """Masks of whole cameras, drawn once each: fixed ones and unchanging regions.

    Parameters
    ----------
    root : of files with a relative path.
    regions : by sensor id.
    """

    def __init__(
        self,
        fixed: Sequence[FixedMask],
        regions: Mapping[str, UnchangingRegion],
        root: Path | None = None,
    ) -> None:
        self._fixed = tuple(fixed)
        self._regions = dict(regions)
        self._root = root
        self._used: set[FixedMask] = set()
        self._drawn: dict[tuple[FixedMask, int, int], Mask] = {}
        self._combined: dict[tuple[object, ...], dict[str, Mask]] = {}

    def of(self, sensor_id: str, image: str, camera: Camera) -> dict[str, Mask]:
        """The masks bool (H, W) of an image by source, in original pixels; shared, not to change.

        Raises
        ------
        DataError : a drawn mask is absent, no image, or not of the camera's size.
        """
        width, height = camera.width, camera.height
        region = self._regions.get(sensor_id)
        fitting = [one for one in self._fixed if one.is_for(sensor_id, image)]
        mine = tuple(one for one in fitting if not (one.fallback and region))
        key = (mine, region, width, height)
        if key not in self._combined:
            masks = {}
            if mine:
                masks["fixed"] = np.logical_and.reduce(
                    [self._draw(one, width, height) for one in mine]
                )
            if region:
                masks["unchanging"] = region.mask(width, height)
            self._combined[key] = masks
        self._used.update(fitting)
        return self._combined[key]

    def unused(self) -> list[FixedMask]:
        """The fixed masks that no image asked for matched."""
        return [one for one in self._fixed if one not in self._used]

    def _draw(self, one: FixedMask, width: int, height: int) -> Mask:
        key = (one, width, height)
        if key not in self._drawn:
            if one.file is None:
                self._drawn[key] = one.drawn(width, height)
            else:
                path = one.file if self._root is None else self._root / one.file
                mask = read_mask(path, (height, width))
                if mask is None:
                    raise DataError("no such mask", path=path)
                self._drawn[key] = mask
        return self._drawn[key]

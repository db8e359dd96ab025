"""What becomes of the images of one camera: undistorted, then resized, then cropped."""

from __future__ import annotations

from dataclasses import dataclass, replace

from pydantic import Field

from megloc_kapture.preprocessing.pixel_map import PixelMap, same_lens
from megloc_kapture.preprocessing.resizing import cropped_size, fitted_size, scaled_camera
from megloc_kapture.preprocessing.undistortion import undistorted_camera
from megloc_kapture.values import Camera, Options


class FrameOptions(Options):
    """Size and projection of the images; by default they stay as they are."""

    max_size_px: int | None = Field(
        default=None, gt=0, description="the larger side of larger images; unset: as it is"
    )
    upscale: bool = Field(
        default=False, description="smaller images get that larger side too, not only larger ones"
    )
    multiple_of: int = Field(
        default=8,
        gt=0,
        description="of both sides where images are resized or undistorted; what is more is cut "
        "off at the right and at the bottom",
    )
    undistort: bool = Field(
        default=False, description="images as a pinhole camera would have taken them"
    )
    blank_pixels: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="undistorted images show, 0: no pixel that was not seen; 1: all that was seen",
    )

    def idle(self) -> dict[str, str]:
        idle = {}
        if self.max_size_px is None:
            idle["upscale"] = "max_size_px says to which size"
            if not self.undistort:
                idle["multiple_of"] = "images are neither resized (max_size_px) nor undistorted"
        if not self.undistort:
            idle["blank_pixels"] = "undistort is off"
        return idle


@dataclass(frozen=True, slots=True)
class FramePlan:
    """One camera and what pre-processing makes of it; the pose stays.

    Parameters
    ----------
    original, processed : the cameras before and after.
    resized : width and height before the crop.
    shrink : how many original pixels of the undistorted image a processed one spans, the larger
        of the two axes; 1 or less where nothing is made smaller.
    """

    original: Camera
    processed: Camera
    resized: tuple[int, int]
    shrink: float

    @property
    def warps(self) -> bool:
        """Whether the images are undistorted."""
        return not same_lens(self.original, self.processed)

    @property
    def changes_pixels(self) -> bool:
        """Whether the images become other ones."""
        size = (self.processed.width, self.processed.height)
        return self.warps or size != (self.original.width, self.original.height)

    def pixel_map(self) -> PixelMap:
        """Carries keypoints between the two."""
        return PixelMap(self.original, self.processed)


def plan_frame(camera: Camera, options: FrameOptions) -> FramePlan:
    """What the options make of a camera.

    Raises
    ------
    OptionError : its images are too small to be cropped.
    """
    lens = camera
    if options.undistort:
        lens = undistorted_camera(camera, blank_pixels=options.blank_pixels)
    warps = not same_lens(camera, lens)
    width, height = lens.width, lens.height
    if options.max_size_px is not None:
        width, height = fitted_size(
            lens.width, lens.height, options.max_size_px, upscale=options.upscale
        )
    processed = scaled_camera(lens, width, height)
    if warps or options.max_size_px is not None:
        cropped_width, cropped_height = cropped_size(width, height, options.multiple_of)
        processed = replace(processed, width=cropped_width, height=cropped_height)
    shrink = max(lens.width / width, lens.height / height)
    return FramePlan(camera, processed, (width, height), shrink)

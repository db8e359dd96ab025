"""``megloc preprocess``: images resized, undistorted and masked, as a kapture of its own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from megloc_kapture.cli.common import (
    Computing,
    Folders,
    Force,
    Input,
    Linked,
    Output,
    Texts,
    Working,
    assigned_pairs,
    existing,
)
from megloc_kapture.errors import OptionError
from megloc_kapture.io.files import first_problem
from megloc_kapture.io.output_folders import replace_directory
from megloc_kapture.pipeline.presets import assigned
from megloc_kapture.stages.devices import placed
from megloc_kapture.stages.preprocessing import (
    REPORT_FILE,
    PreprocessingOptions,
    PreprocessingReport,
    preprocess_images,
    read_report,
)

PREPROCESSED = "preprocessed"

_SOURCES = {
    "own": "masks of the kapture",
    "user": "masks brought along",
    "fixed": "fixed masks",
    "unchanging": "unchanging regions",
    "classes": "dynamic classes",
    "unseen": "outside the original",
    "all": "together",
}


@dataclass(frozen=True, kw_only=True)
class Preprocess(Linked, Computing, Working):
    """Resize, undistort and mask the images of a kapture; poses stay, cameras follow."""

    input: Input
    """Kapture folder; it stays as it is."""
    output: Output
    """Kapture folder of the new images."""
    resize: int | None = None
    """The larger side of larger images, px; both sides are then cropped to multiples of 8."""
    undistort: bool = False
    """Make images that a pinhole camera would have taken."""
    segmenter: str | None = None
    """Segmenter plugin whose dynamic classes (people, vehicles) are masked."""
    dynamic: tuple[str, ...] = ()
    """Classes to mask; the segmenter's own choice unless given."""
    bottom_share: Texts = ()
    """Mask the bottom of a camera's images: CAMERA=0.2, a sensor id or a pattern of image names."""
    polygon: Texts = ()
    """Mask a polygon: CAMERA="x,y x,y x,y", corners in shares of width and height."""
    mask_file: Texts = ()
    """Mask what is 0 in an image of the camera's size: CAMERA=FILE."""
    unchanging: bool = False
    """Mask the region at the bottom that never changes (the car's bonnet), found per camera."""
    sequence: Folders = ()
    """Kapture folder whose images of the same cameras help to find it; may be repeated."""
    user_masks: Path | None = None
    """Folder of masks IMAGE.png, 0 where the image is ignored."""
    set: Texts = ()
    """Change another option: key=value (upscale, multiple_of, blank_pixels); may be repeated."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        options = self.options()
        source = self.kapture(self.input)
        sequences = [self.kapture(path) for path in existing(self.sequence)]
        with self.staged(self.output, PREPROCESSED, force=self.force) as (out, work):
            preprocess_images(source, out, options, sequences=sequences, work=work)
            report = read_report(out)
            # masks and images of an earlier run would be taken for this one's
            if (self.output / "sensors" / REPORT_FILE).is_file():
                replace_directory(out / "sensors", self.output / "sensors")
        for line in () if report is None else report_lines(report):
            console.say(line)
        return 0

    def options(self) -> PreprocessingOptions:
        """The options that the flags make.

        Raises
        ------
        OptionError : one has a value that it cannot have.
        """
        masks: dict[str, Any] = {
            "segmenter": None if self.segmenter is None else {"name": self.segmenter},
            "dynamic": self.dynamic or None,
            "fixed": tuple(self._fixed_masks()),
            "unchanging": self.unchanging,
            "user_masks": self.user_masks,
        }
        tree: dict[str, Any] = {
            "max_size_px": self.resize,
            "undistort": self.undistort,
            **assigned(self.set),
        }
        changes = tree.pop("masks", {})
        try:
            options = PreprocessingOptions.model_validate({**tree, "masks": {**masks, **changes}})
        except ValidationError as error:
            raise OptionError(f"option {first_problem(error)}") from error
        self.check_computes(options)
        return placed(options, self.device or "auto", self.precision or "full")

    def _fixed_masks(self) -> Iterator[dict[str, Any]]:
        takes = "CAMERA=VALUE"
        for camera, value in assigned_pairs("--bottom-share", self.bottom_share, takes):
            yield {"camera": camera, "bottom_share": value}
        for camera, value in assigned_pairs("--polygon", self.polygon, takes):
            yield {"camera": camera, "polygon": [corner.split(",") for corner in value.split()]}
        for camera, value in assigned_pairs("--mask-file", self.mask_file, takes):
            yield {"camera": camera, "file": value}


def report_lines(report: PreprocessingReport) -> list[str]:
    """What was done, for people: cameras, then the share of pixels masked by each source."""
    lines = [f"{report.images} images, {report.images_changed} of them changed"]
    changes: dict[str, int] = {}
    for camera in report.cameras.values():
        before, after = ("{} {}x{}".format(*row[:3]) for row in (camera.original, camera.processed))
        change = before if camera.original == camera.processed else f"{before} -> {after}"
        changes[change] = changes.get(change, 0) + 1
    lines += [
        f"{'cameras' if number > 1 else 'camera'}: {number} {change}"
        for change, number in sorted(changes.items())
    ]
    lines += [f"remark: {remark}" for remark in report.remarks]
    if report.images_masked:
        lines.append(f"masks of {report.images_masked} images; share of all pixels masked:")
        lines += [
            f"  {_SOURCES[source]:24s}{100 * report.masked[source]:7.2f} %"
            for source in _SOURCES
            if source in report.masked
        ]
    return lines

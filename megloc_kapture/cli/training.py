"""``megloc train``, ``train-field`` and ``render``: feature networks and neural fields."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from megloc_kapture.cli.common import (
    AllowedLinks,
    Common,
    Folders,
    Input,
    Inputs,
    Output,
    Overwrite,
    Texts,
    Working,
    camera_of_text,
    kapture_map,
)
from megloc_kapture.errors import DataError, OptionError, check_option, require
from megloc_kapture.io.files import remove
from megloc_kapture.io.images import WRITABLE_SUFFIXES, write_image
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.io.output_folders import check_new_file, claim_folder, release_folder
from megloc_kapture.io.text_lines import numbers_of
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.pipeline.presets import options_with
from megloc_kapture.stages.work import Work
from megloc_kapture.values import RigidTransform


@dataclass(frozen=True, kw_only=True)
class Train(Common):
    """Train SuperGlue, or a detector's descriptors, on kapture folders with depth and on
    photographs. Repeat the command to resume."""

    allow_links_below: AllowedLinks = ()
    task: Annotated[
        tyro.conf.Positional[Literal["matcher", "descriptor"]], tyro.conf.arg(metavar="TASK")
    ]
    """matcher: SuperGlue for frozen features; descriptor: descriptors of a frozen detector's
    keypoints."""
    input: Inputs = ()
    """Kapture folder with poses and depth to train on; may be repeated."""
    photographs: Folders = ()
    """Folder of images to train on under random homographies; may be repeated."""
    held_out: Folders = ()
    """Kapture folder with poses and depth to evaluate on; may be repeated."""
    output: Output
    """File to write: X.safetensors; also writes X.json, X.csv, X.state.pt and X.overlaps."""
    features: str = "superpoint"
    """Extractor whose features are matched, or whose detector is frozen."""
    set: Texts = ()
    """Change an option: key.key=value (steps=20000, max_size_px=800); may be repeated."""
    threads: int = 1
    """Threads that prepare pairs."""
    force: Overwrite = False
    """Overwrite the files of another training run."""

    def run(self) -> None:
        from megloc_kapture.training.train import TASKS, train  # loads torch

        options = options_with(TASKS[self.task], self.set, {"features.name": self.features})
        last = train(
            options,
            self.output,
            kaptures=[kapture_map(path) for path in self.input],
            photographs=self.photographs,
            held_out=[KaptureFolder(path) for path in self.held_out],
            force=self.force,
            threads=self.threads,
            work=Work(track=self.track),
        )
        for name, value in last.items():
            if value == value:
                print(f"{name.replace('_', ' '):20s}{value:>12.6g}")
        print(f"trained: {self.output}")


FIELD = "field"
RENDERED = "rendered"
_MILLIMETRES = 1000.0
_MIN_SHOWN = 0.5


@dataclass(frozen=True, kw_only=True)
class TrainField(Common):
    """Train a neural field (NeRF-W) on the images of a map, to render views and refine poses.
    Repeat the command to resume."""

    allow_links_below: AllowedLinks = ()
    input: Input
    """Kapture map: images with poses, optionally masks and depth maps."""
    output: Output
    """Folder of the field: field.json and field.safetensors."""
    kind: Literal["triplane", "nerfw"] = "triplane"
    """triplane: minutes on a CPU; nerfw: the published network, for a GPU."""
    steps: int = 4000
    """Number of training steps."""
    minutes: float | None = None
    """Stop after this many minutes; the result is then not reproducible."""
    max_side: int = 320
    """Longer side of the training images, px; larger images are reduced."""
    held_out_every: int = 8
    """Hold out every N-th image to measure PSNR; 0: none."""
    lights: Literal["image", "folder"] = "image"
    """Learn one appearance per image, or per folder of images (a session)."""
    seed: int = 0
    """Seed of all random numbers."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto: a GPU if available."""
    half_precision: bool = False
    """Compute in bfloat16; faster on a GPU."""
    compiled: bool = False
    """Use torch.compile: faster on a GPU after minutes of compilation; needs a C compiler."""
    force: Overwrite = False
    """Write into a non-empty folder; start the training again."""

    def run(self) -> None:
        # these load torch
        from megloc_kapture.refinement.field_training import FieldTrainingOptions
        from megloc_kapture.stages.neural_field import STATE_FILE, train_field_of_map

        of_same_name = vars(self).keys() & FieldTrainingOptions.model_fields
        changes = {"max_side_px": self.max_side} | {name: vars(self)[name] for name in of_same_name}
        options = options_with(FieldTrainingOptions, changes)

        def progress(step: int, seconds: float, psnr_db: list[float]) -> None:
            held_out = ", ".join(f"{value:.1f}" for value in psnr_db)
            self.say(
                f"  step {step} of {self.steps}, {seconds:.0f} s"
                + (f", held-out images {held_out} dB" if held_out else "")
            )

        mapping, state = kapture_map(self.input), self.output / STATE_FILE
        is_new = claim_folder(self.output, kind=FIELD, force=self.force)
        try:
            if self.force:
                remove(state)
            with single_threaded():
                psnr_db = train_field_of_map(mapping, self.output, options, progress=progress)
        except BaseException:
            if is_new and not state.exists():
                release_folder(self.output)
            raise
        mean = f"{sum(psnr_db.values()) / len(psnr_db):.1f} dB" if psnr_db else "none held out"
        print(f"{self.output}: PSNR of {len(psnr_db)} held-out images: {mean}")


@dataclass(frozen=True, kw_only=True)
class Render(Working):
    """Render views of a neural field: at a pose, at a result's poses, or between map cameras."""

    allow_links_below: AllowedLinks = ()
    field: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FIELD")]
    """Folder that megloc train-field wrote."""
    output: Output
    """Image file for --pose, kapture folder for --along and --between."""
    pose: str | None = None
    """cam_from_world as qw,qx,qy,qz,tx,ty,tz; write --pose=... if the first number is negative."""
    camera: str | None = None
    """For --pose: MODEL,WIDTH,HEIGHT,PARAMETERS as in COLMAP."""
    depth: Path | None = None
    """For --pose: write the depth to this file, a 16-bit PNG in thousandths of the map's unit, 0
    where nothing is rendered or it exceeds 65.535 units."""
    along: Path | None = None
    """Kapture folder, such as a result: render view and depth of each of its images with a pose."""
    between: Path | None = None
    """Map: render views halfway between neighbouring cameras, with depth, as additional map images
    (merge them with kapture_merge); views with less than half of their pixels on the scene are
    omitted."""
    max_side: int | None = None
    """For --along and --between: longer side of the renderings, px; larger ones are reduced."""
    appearance: str | None = None
    """Training image whose lighting is used; if omitted, the mean lighting of all."""
    force: Overwrite = False
    """Overwrite a file, or write into a non-empty folder."""

    def run(self) -> None:
        from megloc_kapture.stages.neural_field import render_along, views_between  # load torch

        if sum(each is not None for each in (self.pose, self.along, self.between)) != 1:
            raise OptionError("give one of --pose (with --camera), --along and --between")
        many = self.along or self.between
        if many is None:
            self._render_one()
            print(f"rendered: {self.output}")
            return
        if self.max_side is not None and self.max_side < 1:
            raise OptionError(f"--max-side {self.max_side} is not positive")
        data = kapture_map(many).read()
        require(data.poses(), "no image here has a pose", path=many)
        with self.staged(self.output, RENDERED, force=self.force) as (out, work):
            count = render_along(
                self.field,
                data if self.between is None else views_between(data),
                out,
                appearance=self.appearance,
                max_side_px=self.max_side,
                min_shown=0.0 if self.between is None else _MIN_SHOWN,
                work=work,
            )
        print(f"{count} views rendered: {self.output}")

    def _render_one(self) -> None:
        from megloc_kapture.stages.neural_field import open_field

        if self.pose is None or self.camera is None:
            raise OptionError("--pose needs --camera")
        pose, camera = _pose_of_text(self.pose), camera_of_text(self.camera)
        for path, known in ((self.output, WRITABLE_SUFFIXES), (self.depth, (".png",))):
            if path is None:
                continue
            check_option(
                path.suffix.lower() in known, f"{path}: the file must end in {' or '.join(known)}"
            )
            check_new_file(path, force=self.force)
        with single_threaded():
            field = open_field(self.field)
            light = None if self.appearance is None else field.appearance_of(self.appearance)
            rendered, depth_m = field.render(camera, pose, appearance=light)
        write_image(self.output, rendered.image)
        if self.depth is not None:
            stored = np.round(depth_m * _MILLIMETRES)
            write_image(self.depth, np.where(stored > 65535, 0, stored).astype(np.uint16))


def _pose_of_text(text: str) -> RigidTransform:
    """Parse ``cam_from_world`` as ``qw,qx,qy,qz,tx,ty,tz``."""
    try:
        w, x, y, z, tx, ty, tz = numbers_of(text.split(","), "qw qx qy qz tx ty tz")
        return RigidTransform(unit_quaternion((w, x, y, z)), (tx, ty, tz))
    except DataError:
        raise OptionError(f"--pose {text}: give qw,qx,qy,qz,tx,ty,tz") from None

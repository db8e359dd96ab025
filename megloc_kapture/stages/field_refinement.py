"""Pose refiner ``field``: the query is matched with what a neural field shows at its pose.

Render, match, solve: colour and depth are rendered at the initial pose, local features of query and
rendering matched, lifted by the rendered depth, and the pose solved (as GS-CPR, Liu et al., ICLR
2025, does with splats). Renderings from there are aligned with the query as map images are by
``rendering``, and the pose is accepted by its rules. The query's light is fitted on every other
square of it, and the others are what its pose is accepted by. Descending on colours from the
initial pose is slower and heals less.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import OptionError
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions, absolute_pose
from megloc_kapture.mapping.depth import sample_depth
from megloc_kapture.plugin_loading import load_plugin, weights_of
from megloc_kapture.plugins import (
    LOCAL_FEATURES,
    MATCHERS,
    DepthView,
    LocalFeatureExtractor,
    Matcher,
    PluginChoice,
    PoseRefinement,
    RankingScene,
)
from megloc_kapture.refinement.acceptance import RenderingOptions
from megloc_kapture.refinement.references import RenderingQuery, RenderingReference
from megloc_kapture.refinement.rendering import judge_by_rendering
from megloc_kapture.values import Camera, Device, Failure, ImageFeatures, Options, RigidTransform

if TYPE_CHECKING:
    import torch

    from megloc_kapture.refinement.neural_field import FieldRendering

# of the pose that was solved, each by a rendering from where the last one led
_ALIGNMENTS = 2
# neighbouring rendered depths that differ by more, a share, are of an edge: not lifted
_MAX_JUMP = 0.05
_MAX_ERROR_PX = 3.0


class FieldRefinerOptions(Options):
    """Options of the refinement by a neural field."""

    field: str = Field(default="", description="folder that megloc train-field wrote")
    device: Device = Field(default="auto", description="of the field: auto, cpu, cuda or cuda:N")
    features: PluginChoice = Field(
        default=PluginChoice(name="rootsift"), description="local features that are matched"
    )
    matcher: PluginChoice = Field(
        default=PluginChoice(name="nn", options={"max_ratio": 0.9}),
        description="of query and rendering",
    )
    max_side_px: int = Field(
        default=320, ge=64, description="longer side of the rendering; larger queries are reduced"
    )
    max_translation_m: float = Field(
        default=0.5, gt=0, description="a pose whose centre moves further is not accepted"
    )
    max_rotation_deg: float = Field(
        default=5.0, gt=0, description="a pose that turns further is not accepted"
    )


class FieldRefiner:
    """Plugin ``field``: see the module."""

    name = "field"
    Options = FieldRefinerOptions

    def __init__(self, options: FieldRefinerOptions | None = None) -> None:
        self.options = options or FieldRefinerOptions()
        if not self.options.field:
            raise OptionError(
                "the pose refiner field needs a field that megloc train-field wrote: --set "
                '\'pose_refinement.by=[{name="field",options={field="FOLDER"}}]\''
            )
        one, other = self.options.features, self.options.matcher
        self._features: LocalFeatureExtractor = load_plugin(LOCAL_FEATURES, one.name, one.options)
        self._matcher: Matcher = load_plugin(MATCHERS, other.name, other.options)

    def plugins(self) -> tuple[object, ...]:
        """Those it is made of."""
        return (self._features, self._matcher)

    def weights(self) -> dict[str, str]:
        """The field's tensors, and those of features and matcher."""
        from megloc_kapture.io.weights import sha256_of
        from megloc_kapture.stages.neural_field import weights_file

        file = weights_file(Path(self.options.field))
        return {
            file.name: sha256_of(file),
            **weights_of(self._features),
            **weights_of(self._matcher),
        }

    def refine(
        self,
        query: str,
        camera: Camera,
        cam_from_world: RigidTransform,
        references: Sequence[str],
        scene: RankingScene,
    ) -> PoseRefinement:
        """Refine the pose of a query; the references are not looked at.

        Raises DataError: the query's pixels or the field cannot be read.
        """
        from megloc_kapture.refinement.neural_field import FieldView
        from megloc_kapture.stages.neural_field import open_field

        field = open_field(Path(self.options.field), self.options.device)
        image, mask = scene.query_image(query), scene.query_mask(query)
        fitted = _checkers(image.shape[:2])
        used = fitted if mask is None else fitted & mask
        side = self.options.max_side_px

        def light_at(pose: RigidTransform) -> torch.Tensor | None:
            return field.fitted_appearance(FieldView(query, image, camera, pose, used), side)

        light = light_at(cam_from_world)
        first = field.render(camera, cam_from_world, appearance=light, max_side_px=side)
        solved = self._solve(self._extract(image, mask, first.camera), first, cam_from_world)
        if isinstance(solved, Failure):
            return PoseRefinement(cam_from_world, f"query and rendering: {solved.reason}")
        seen = RenderingQuery(image, camera, mask)
        options = RenderingOptions(
            appearance="colours",
            max_side_px=side,
            levels=1,
            max_translation_m=self.options.max_translation_m,
            max_rotation_deg=self.options.max_rotation_deg,
        )
        pose, light = solved, light_at(solved)
        for _ in range(_ALIGNMENTS):
            shown = field.render(camera, pose, appearance=light, max_side_px=side)
            depth = DepthView(shown.camera, shown.depth_m, RigidTransform.identity())
            reference = RenderingReference(shown.image, shown.camera, pose, depth)
            judged = judge_by_rendering(
                seen, [reference], cam_from_world, pose, options, judged=~fitted
            )
            if not judged.accepted:
                break
            pose = judged.cam_from_world
        return judged

    def _extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None, camera: Camera
    ) -> ImageFeatures:
        """Features of an image in the size of a camera."""
        size = camera.width, camera.height
        if image.shape[:2] != size[::-1]:
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
            if mask is not None:
                mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0
        found = self._features.extract(image, mask)
        return ImageFeatures(found.keypoints_px, found.descriptors, *size)

    def _solve(
        self, query: ImageFeatures, rendering: FieldRendering, pose: RigidTransform
    ) -> RigidTransform | Failure:
        """The query's pose by its matches with a rendering at a pose near it."""
        shown = self._extract(rendering.image, rendering.depth_m > 0, rendering.camera)
        rows, _ = self._matcher.match(query, shown)
        px = shown.keypoints_px[rows[:, 1], :2].astype(np.float64)
        depth = sample_depth(rendering.depth_m, px, _MAX_JUMP, whole=True)
        known = np.isfinite(depth)
        in_cam = bearing_rays(rendering.camera, px[known]) * depth[known, None]
        options = AbsolutePoseOptions(max_error_px=_MAX_ERROR_PX)
        found = absolute_pose(
            query.keypoints_px[rows[known, 0], :2],
            pose.inverse().apply(in_cam),
            rendering.camera,
            options,
        )
        return found.cam_from_world if found else found


def _checkers(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Every other of the squares, ten along the longer side, into which an image is divided."""
    height, width = shape
    squares = [np.arange(side) * 10 // max(shape) for side in (height, width)]
    return np.asarray((squares[0][:, None] + squares[1]) % 2 == 0)

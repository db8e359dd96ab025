"""Neural fields of kapture maps: training, storage, rendering and pose refinement.

A field folder has ``field.json`` (architecture and training data) and ``field.safetensors``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from megloc_kapture.errors import check_option, require
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.geometry.warping import PosedImage
from megloc_kapture.io.files import (
    read_content,
    read_json_model,
    remove,
    write_bytes,
    write_json_model,
)
from megloc_kapture.io.images import write_depth_map, write_image
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.io.weights import WeightsFile, describe, read_weights, sha256_of
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions, absolute_pose
from megloc_kapture.mapping.depth import sample_depth
from megloc_kapture.mapping.pairs import PairsByPosesOptions, pairs_by_poses
from megloc_kapture.nets.runtime import load_strictly, pick_device
from megloc_kapture.plugin_loading import NetworkOptions, load_chosen, weights_of
from megloc_kapture.plugins import (
    LOCAL_FEATURES,
    MATCHERS,
    LocalFeatureExtractor,
    Matcher,
    PluginChoice,
    PoseRefinement,
    RankingScene,
)
from megloc_kapture.refinement.acceptance import RenderingOptions
from megloc_kapture.refinement.field_training import FieldTrainer, FieldTrainingOptions
from megloc_kapture.refinement.neural_field import (
    FieldFrame,
    Kind,
    NeuralField,
    build_field,
    light_rows,
)
from megloc_kapture.refinement.rendering import RenderingRefinement
from megloc_kapture.stages.scene import KaptureScene
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Camera, Device, Failure, ImageFeatures, Options, RigidTransform

FIELD_FILE, MANIFEST_FILE = "field.safetensors", "field.json"
STATE_FILE = "field.state.pt"  # during training
# neighbours per camera for views between cameras; largest angle between viewing directions
_NEIGHBOURS, _MAX_ANGLE_DEG = 2, 45.0
# alignments of the solved pose, each with a new rendering
_ALIGNMENTS = 2
# neighbouring pixels with a larger relative depth difference are an edge, and are not used
_MAX_JUMP = 0.05
_MAX_ERROR_PX = 3.0


class FieldManifest(BaseModel):
    """``field.json``; ``images`` are in the order of the transient embeddings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Kind
    frame: FieldFrame
    images: Annotated[list[str], Field(min_length=1)]
    held_out_psnr_db: dict[str, float | None]
    options: FieldTrainingOptions


def train_field_of_map(
    mapping: KaptureFolder,
    output: Path,
    options: FieldTrainingOptions,
    *,
    progress: Callable[[int, float, list[float]], None] | None = None,
) -> Mapping[str, float]:
    """Train a field on the posed images of a map, or resume an interrupted training run.

    Masks and depth are used where available. Return the PSNR in dB of each held-out image.
    """
    from safetensors.torch import save

    trainer, state = FieldTrainer(views_of(mapping), options), output / STATE_FILE
    if state.is_file():
        trainer.resume(read_content(state), state)
    field, psnr = trainer.train(progress=progress, keep=partial(write_bytes, state))
    module = field.module.cpu()
    tensors = {name: value.contiguous() for name, value in module.state_dict().items()}
    write_bytes(output / FIELD_FILE, save(tensors))
    known = {name: None if value != value else value for name, value in psnr.items()}
    manifest = FieldManifest(
        kind=options.kind,
        frame=field.frame,
        images=list(field.images),
        held_out_psnr_db=known,
        options=options,
    )
    write_json_model(output / MANIFEST_FILE, manifest)
    remove(state)
    return psnr


def views_of(mapping: KaptureFolder) -> list[PosedImage]:
    """Return the posed images of a map, sorted by name, with masks and depth."""
    scene = KaptureScene(mapping)
    return [
        PosedImage(
            scene.map_image(name),
            scene.map_camera(name),
            pose,
            scene.map_depth(name),
            scene.map_mask(name),
            name,
        )
        for name, pose in mapping.read().poses().items()
    ]


def open_field(folder: Path, device: Device = "auto") -> NeuralField:
    """Open a field folder; opened fields are cached in memory."""
    return _opened(weights_file(folder), device)


def weights_file(folder: Path) -> WeightsFile:
    require(
        (folder / FIELD_FILE).is_file(),
        f"no {FIELD_FILE} here; megloc train-field writes one",
        path=folder,
    )
    return describe(FIELD_FILE, (folder / FIELD_FILE).absolute())


@lru_cache(maxsize=2)
def _opened(file: WeightsFile, device: Device) -> NeuralField:
    manifest = read_json_model(file.path.with_name(MANIFEST_FILE), FieldManifest)
    rows = light_rows(manifest.images, manifest.options.lights)
    module = build_field(manifest.kind, len(manifest.images), max(rows) + 1)
    load_strictly(module, read_weights(file), str(file.path))
    module.requires_grad_(False)
    return NeuralField(module.to(pick_device(device)), manifest.frame, manifest.images, rows)


def views_between(data: KaptureData) -> KaptureData:
    """Create views halfway between each camera and its nearest cameras with a similar direction.

    New sensor ids let kapture merge the renderings with the map.
    """
    names, poses = data.image_names(), data.poses()
    names = [name for name in names if name in poses]
    near = PairsByPosesOptions(num_neighbours=_NEIGHBOURS, max_angle_deg=_MAX_ANGLE_DEG)
    pairs = pairs_by_poses([poses[name] for name in names], near).tolist()
    require(
        pairs, "no two cameras have a similar viewing direction: there are no views between them"
    )
    between = KaptureData()
    for number, (a, b) in enumerate(pairs):
        first, second = poses[names[a]], poses[names[b]]
        quat, other = np.array(first.quat_wxyz), np.array(second.quat_wxyz)
        middle = quat + math.copysign(1.0, quat @ other) * other
        w, x, y, z = (middle / np.linalg.norm(middle)).tolist()
        turned = RigidTransform((w, x, y, z), (0.0, 0.0, 0.0))
        t_x, t_y, t_z = turned.apply(-0.5 * (first.center() + second.center())).tolist()
        sensor = f"{data.record_of(names[a])[1]}_between"
        between.sensors[sensor] = Sensor.from_camera(data.camera_of(names[a]))
        between.trajectories[number, sensor] = RigidTransform(turned.quat_wxyz, (t_x, t_y, t_z))
        between.records_camera[number, sensor] = f"between/{number:06d}.png"
    return between


@dataclass(frozen=True)
class _Renderer:
    field: Path
    records: Path
    appearance: str | None
    max_side_px: int | None
    min_shown: float
    options: NetworkOptions = NetworkOptions()

    def __call__(self, view: tuple[str, Camera, RigidTransform]) -> Camera | None:
        name, camera, pose = view
        field = open_field(self.field, self.options.device)
        light = None if self.appearance is None else field.appearance_of(self.appearance)
        side = self.max_side_px
        rendered, depth_m = field.render(camera, pose, appearance=light, max_side_px=side)
        if np.mean(depth_m > 0) < self.min_shown:
            return None
        image, depth = (self.records / part for part in _files_of(name))
        image.parent.mkdir(parents=True, exist_ok=True)
        write_image(image, rendered.image)
        write_depth_map(depth, depth_m)
        return rendered.camera


def _files_of(name: str) -> tuple[str, str]:
    stem = Path(name).with_suffix("")
    return f"{stem}.png", f"{stem}.depth"


def render_along(
    field: Path,
    data: KaptureData,
    output: Path,
    *,
    appearance: str | None = None,
    max_side_px: int | None = None,
    min_shown: float = 0.0,
    work: Work = HERE,
) -> int:
    """Render the posed images of a kapture to a new one with depth; return the number written.

    Parameters
    ----------
    appearance : training image whose lighting is used; the mean of all by default.
    max_side_px : longer side of the renderings; larger cameras are scaled down.
    min_shown : smallest proportion of pixels with depth; views with less depth are left out.
    """
    poses = data.poses()
    require(poses, "no image here has a pose")
    known = open_field(field)
    if appearance is not None:
        known.appearance_of(appearance)
    records = output / "sensors" / "records_data"
    renderer = _Renderer(field.absolute(), records, appearance, max_side_px, min_shown)
    views = [(name, data.camera_of(name), pose) for name, pose in poses.items()]
    written = KaptureData()
    cameras = work.map(renderer, views, "views", plugins=(renderer,))
    for (name, _, pose), camera in zip(views, cameras, strict=True):
        if camera is None:
            continue
        timestamp, sensor = data.record_of(name)
        image, depth = _files_of(name)
        ids = sensor, f"{sensor}_depth"
        for sensor_id, kind in zip(ids, ("camera", "depth"), strict=True):
            written.sensors[sensor_id] = Sensor.from_camera(camera, sensor_type=kind)
            written.trajectories[timestamp, sensor_id] = pose
        # kapture associates depth with an image by their common rig
        same = RigidTransform.identity()
        written.rigs[f"{sensor}_with_depth"] = dict.fromkeys(ids, same)
        written.records_camera[timestamp, ids[0]] = image
        written.records_depth[timestamp, ids[1]] = depth
    write_sensors(output, written)
    return len(written.records_camera)


class FieldRefinerOptions(Options):
    field: str = Field(default="", description="folder written by megloc train-field")
    device: Device = Field(
        default="auto", description="device of all networks: auto, cpu, cuda or cuda:N"
    )
    half_precision: bool = Field(
        default=False, description="half precision of features and matcher"
    )
    features: PluginChoice = Field(
        default=PluginChoice(name="rootsift"), description="local features to match"
    )
    matcher: PluginChoice = Field(
        default=PluginChoice(name="nn", options={"max_ratio": 0.9}),
        description="matcher for query and rendering",
    )
    max_side_px: int = Field(
        default=320, ge=64, description="longer side of the rendering; larger queries are reduced"
    )
    max_translation_m: float = Field(
        default=0.5, gt=0, description="largest accepted movement of the camera centre"
    )
    max_rotation_deg: float = Field(default=5.0, gt=0, description="largest accepted rotation")


class FieldRefiner:
    """Plugin ``field``: match the query with the field's rendering at its pose.

    Features of query and rendering are matched, and the rendered depth gives 3D points, from which
    the pose is solved (as in GS-CPR, Liu et al., ICLR 2025). Then new renderings are aligned with
    the query, and the pose is accepted or rejected, as by the ``rendering`` refiner. The lighting
    is fitted on one half of a checkerboard over the query; acceptance uses the other half.
    """

    name = "field"
    Options = FieldRefinerOptions

    def __init__(self, options: FieldRefinerOptions | None = None) -> None:
        self.options = options or FieldRefinerOptions()
        check_option(
            self.options.field,
            "the pose refiner 'field' needs a folder written by megloc train-field: --set "
            '\'pose_refinement.by=[{name="field",options={field="FOLDER"}}]\'',
        )
        placement = NetworkOptions(
            device=self.options.device, half_precision=self.options.half_precision
        )
        self._features: LocalFeatureExtractor = load_chosen(
            LOCAL_FEATURES, self.options.features, placement
        )
        self._matcher: Matcher = load_chosen(MATCHERS, self.options.matcher, placement)

    def plugins(self) -> tuple[object, ...]:
        return (self._features, self._matcher)

    def weights(self) -> dict[str, str]:
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
        """Refine the pose of a query; ``references`` are ignored."""
        field = open_field(Path(self.options.field), self.options.device)
        image, mask = scene.query_image(query), scene.query_mask(query)
        fitted = _checkers(image.shape[:2])
        used = fitted if mask is None else fitted & mask
        side = self.options.max_side_px

        def light_at(pose: RigidTransform) -> torch.Tensor | None:
            return field.fitted_appearance(PosedImage(image, camera, pose, mask=used), side)

        light = light_at(cam_from_world)
        first, depth_m = field.render(camera, cam_from_world, appearance=light, max_side_px=side)
        solved = self._solve(self._extract(image, mask, first.camera), first, depth_m)
        if isinstance(solved, Failure):
            return PoseRefinement(cam_from_world, f"query and rendering: {solved.reason}")
        seen = PosedImage(image, camera, cam_from_world, mask=mask)
        options = RenderingOptions(
            appearance="colours",
            max_side_px=side,
            max_translation_m=self.options.max_translation_m,
            max_rotation_deg=self.options.max_rotation_deg,
        )
        pose, light = solved, light_at(solved)
        for _ in range(_ALIGNMENTS):
            shown, _ = field.render(camera, pose, appearance=light, max_side_px=side)
            judged = RenderingRefinement(seen, [shown], options).judge(pose, ~fitted)
            if not judged.accepted:
                break
            pose = judged.cam_from_world
        return judged

    def _extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None, camera: Camera
    ) -> ImageFeatures:
        size = camera.width, camera.height
        if image.shape[:2] != size[::-1]:
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
            if mask is not None:
                mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0
        features = self._features.extract(image, mask)
        return ImageFeatures(features.keypoints_px, features.descriptors, *size)

    def _solve(
        self, query: ImageFeatures, rendering: PosedImage, depth_m: NDArray[np.float32]
    ) -> RigidTransform | Failure:
        shown = self._extract(rendering.image, depth_m > 0, rendering.camera)
        rows, _ = self._matcher.match(query, shown)
        px = shown.keypoints_px[rows[:, 1], :2].astype(np.float64)
        depth = sample_depth(depth_m, px, _MAX_JUMP, whole=True)
        known = np.isfinite(depth)
        in_cam = bearing_rays(rendering.camera, px[known]) * depth[known, None]
        options = AbsolutePoseOptions(max_error_px=_MAX_ERROR_PX)
        solution = absolute_pose(
            query.keypoints_px[rows[known, 0], :2],
            rendering.cam_from_world.inverse().apply(in_cam),
            rendering.camera,
            options,
        )
        return solution.cam_from_world if solution else solution


def _checkers(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return a checkerboard mask with ten squares along the longer side."""
    rows, columns = np.indices(shape) * 10 // max(shape)
    return np.asarray((rows + columns) % 2 == 0)

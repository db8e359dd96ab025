"""A map as a radiance field: trained on posed images, it renders colour and depth anywhere.

Trained with the loss of NeRF-W (:func:`~megloc_kapture.nets.radiance.nerf_w_loss`) on random pixels
of all images but every eighth, which are held out; where an image has depth, the field's own is
drawn to it. As NeRF-W judges, the appearance of a held-out image is fitted on its left half, and
the error taken on its right.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import pixel_rays
from megloc_kapture.geometry.warping import WarpSource, scaled_camera, warp_to_view
from megloc_kapture.nets.nerfw import NerfW
from megloc_kapture.nets.radiance import Rays, Rendered, nerf_w_loss
from megloc_kapture.nets.runtime import NetworkOptions, pick_device
from megloc_kapture.nets.triplane import TriPlane
from megloc_kapture.plugins import DepthView
from megloc_kapture.values import Camera, Options, RigidTransform

Kind = Literal["triplane", "nerfw"]
Floats = NDArray[np.float32]
HELD_OUT_EVERY = 8
_CHUNK = 8192  # rays that are rendered at once
# Adam's rates at the beginning; at the end a thirtieth
_PLANE_RATE, _RATE, _NERF_RATE = 2e-2, 5e-3, 5e-4
_DECAY = 1 / 30
# of an appearance: Adam's rate, its steps, the rays of each, and those that are drawn of
_FIT_RATE, _FIT_STEPS, _FIT_RAYS, _FIT_OF = 0.1, 20, 512, 2048


class FieldTrainingOptions(NetworkOptions):
    """Options of a field's training."""

    kind: Kind = Field(
        default="triplane", description="triplane: minutes on a processor; nerfw: needs a GPU"
    )
    steps: int = Field(default=4000, gt=0, description="of the training")
    minutes: float | None = Field(
        default=None,
        gt=0,
        description="end the training after so many at the latest; without, the same bytes twice",
    )
    rays_per_step: int = Field(default=2048, gt=0, description="random pixels of all images")
    max_side_px: int = Field(
        default=320, ge=16, description="longer side of an image; larger ones are reduced"
    )
    depth_weight: float = Field(
        default=5.5, ge=0, description="of the relative error of depth in NeRF-W's loss"
    )
    seed: int = 0


@dataclass(frozen=True, eq=False)
class FieldView:
    """An image to train on; shapes as of :class:`~.references.RenderingReference`.

    Attributes
    ----------
    depth : taken with it; None where nothing was.
    """

    name: str
    image: NDArray[np.uint8]
    camera: Camera
    cam_from_world: RigidTransform
    mask: NDArray[np.bool_] | None = None
    depth: DepthView | None = None


class FieldFrame(Options):
    """Where a field's own coordinates lie in the world.

    ``x_field = (x_world - centre) / scale``; rays begin and end at ``near`` and ``far``, depths
    along the optical axis. All in the unit of the map.
    """

    centre: tuple[float, float, float]
    scale: float = Field(gt=0)
    near: float = Field(gt=0)
    far: float = Field(gt=0)


@dataclass(frozen=True, eq=False)
class FieldRendering:
    """A view of a field.

    Attributes
    ----------
    image : uint8 (H, W, 3), RGB.
    depth_m : float32 (H, W) along the optical axis, unit of the map; 0 where the field is mostly
        empty.
    camera : of the rendering: the view's, reduced.
    """

    image: NDArray[np.uint8]
    depth_m: Floats
    camera: Camera


def build_field(kind: Kind, num_images: int) -> NerfW | TriPlane:
    """An untrained field, its parameters drawn by torch's own generator."""
    return NerfW(num_images) if kind == "nerfw" else TriPlane(num_images)


class NeuralField:
    """A field, its frame, and the images whose appearance it knows.

    Parameters
    ----------
    module : in the mode and on the device that it is used in.
    images : names, in the order of the embeddings' rows.
    """

    def __init__(self, module: NerfW | TriPlane, frame: FieldFrame, images: Sequence[str]) -> None:
        self.module, self.frame, self.images = module, frame, tuple(images)
        self.device = next(module.parameters()).device

    def rays(self, camera: Camera, cam_from_world: RigidTransform) -> Rays:
        """Rays (H * W,) through the centres of a view's pixels, by rows."""
        directions = pixel_rays(camera) @ cam_from_world.rotation_matrix()
        origin = (cam_from_world.center() - self.frame.centre) / self.frame.scale
        there = self._tensor(directions / self.frame.scale)
        return Rays(self._tensor(origin).expand_as(there), there, self.frame.near, self.frame.far)

    def appearance_of(self, image: str) -> torch.Tensor | None:
        """Embedding (A,) of an image's light; None where the field has none of them.

        Raises
        ------
        DataError : it was not trained on that image.
        """
        if image not in self.images:
            raise DataError(f"the field was not trained on an image {image!r}")
        embedding = self.module.appearance
        return None if embedding is None else embedding.weight[self.images.index(image)].detach()

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        cam_from_world: RigidTransform,
        *,
        appearance: torch.Tensor | None = None,
        max_side_px: int | None = None,
    ) -> FieldRendering:
        """Render a view, without what is transient.

        Parameters
        ----------
        appearance : embedding (A,); the mean of all images' unless given.
        max_side_px : of the rendering; the camera's own unless given.
        """
        camera = reduced(camera, max_side_px or max(camera.width, camera.height))
        found = self.render_rays(self.rays(camera, cam_from_world), appearance)
        shape = camera.height, camera.width
        rgb = (found.rgb * 255).round().clamp(0, 255).byte().cpu().numpy().reshape(*shape, 3)
        depth = torch.where(found.opacity > 0.5, found.depth, 0.0).cpu().numpy().reshape(shape)
        return FieldRendering(rgb, depth.astype(np.float32), camera)

    def render_rays(self, rays: Rays, appearance: torch.Tensor | None = None) -> Rendered:
        """Render rays in parts, all with one appearance (A,) or the mean; no transients."""
        parts = []
        for start in range(0, len(rays.origins), _CHUNK):
            part = select(rays, slice(start, start + _CHUNK))
            if appearance is not None:
                part = replace(part, appearance=appearance.expand(len(part.origins), -1))
            parts.append(self.module.render(part))
        rgb, depth, opacity, beta, weights = (
            torch.cat([getattr(one, name) for one in parts])
            for name in ("rgb", "depth", "opacity", "beta", "weights")
        )
        return Rendered(rgb, depth, opacity, beta, weights, parts[0].transient_density)

    def fit_appearance(
        self, rays: Rays, rgb: torch.Tensor, *, seed: int = 0
    ) -> torch.Tensor | None:
        """Embedding (A,) under which rays look most like colours (N, 3); None without any."""
        embedding = self.module.appearance
        if embedding is None:
            return None
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.randperm(len(rgb), generator=generator)[:_FIT_OF].to(self.device)
        rays, rgb = select(rays, drawn), rgb[drawn]
        with torch.no_grad():  # where samples lie does not depend on the light
            seen = self.render_rays(rays)
            rays = replace(rays, depth=torch.where(seen.opacity > 0.5, seen.depth, 0.0))
        fitted = embedding.weight.detach().mean(0).clone().requires_grad_()
        optimizer = torch.optim.Adam([fitted], lr=_FIT_RATE)
        for _ in range(_FIT_STEPS):
            rows = torch.randint(len(rgb), (min(_FIT_RAYS, len(rgb)),), generator=generator)
            rows = rows.to(self.device)
            part = replace(select(rays, rows), appearance=fitted.expand(len(rows), -1))
            # what is transient in the image must not pull on its light
            loss = _huber(self.module.render(part).rgb - rgb[rows])
            (fitted.grad,) = torch.autograd.grad(loss, [fitted])
            optimizer.step()
        return fitted.detach()

    def fitted_appearance(self, view: FieldView, max_side_px: int) -> torch.Tensor | None:
        """Embedding (A,) of a view's light, of an image reduced to that longer side."""
        camera, rgb, usable, _ = _pixels(view, max_side_px)
        rows = torch.from_numpy(np.flatnonzero(usable)).to(self.device)
        if not len(rows):
            return None
        rays = select(self.rays(camera, view.cam_from_world), rows)
        return self.fit_appearance(rays, self._tensor(rgb.astype(np.float32) / 255)[rows])

    def held_out_psnr(self, view: FieldView) -> float:
        """PSNR in dB on the right half of an image, its appearance fitted on the left one."""
        camera, rgb, usable, _ = _pixels(view, max(view.camera.width, view.camera.height))
        rays = self.rays(camera, view.cam_from_world)
        left = np.arange(camera.width * camera.height) % camera.width < camera.width // 2
        seen = self._tensor(rgb.astype(np.float32) / 255)
        ours, judged = (
            torch.from_numpy(np.flatnonzero(usable & half)).to(self.device)
            for half in (left, ~left)
        )
        if not len(ours) or not len(judged):
            return float("nan")
        appearance = self.fit_appearance(select(rays, ours), seen[ours])
        with torch.no_grad():
            found = self.render_rays(select(rays, judged), appearance).rgb
        error = torch.square(found.clamp(0, 1) - seen[judged]).mean()
        return float(-10 * torch.log10(error.clamp_min(1e-10)))

    def _tensor(self, values: NDArray[np.floating]) -> torch.Tensor:
        return torch.from_numpy(np.asarray(values, np.float32)).to(self.device)


def _huber(difference: torch.Tensor) -> torch.Tensor:
    """Mean Huber loss of differences of colour, linear from a tenth of full scale."""
    return torch.nn.functional.huber_loss(difference, torch.zeros_like(difference), delta=0.1)


def select(rays: Rays, rows: slice | torch.Tensor) -> Rays:
    """Some of the rays."""
    chosen = {
        name: value[rows]
        for name in ("origins", "directions", "appearance", "transient", "depth")
        if (value := getattr(rays, name)) is not None
    }
    return replace(rays, **chosen)


def reduced(camera: Camera, max_side_px: int) -> Camera:
    """The camera of the image reduced to a longer side; never enlarged."""
    longer = max(camera.width, camera.height)
    return camera if longer <= max_side_px else scaled_camera(camera, max_side_px / longer)


def train_field(
    views: Sequence[FieldView],
    options: FieldTrainingOptions | None = None,
    *,
    module: NerfW | TriPlane | None = None,
    progress: Callable[[int, float, list[float]], None] | None = None,
) -> tuple[NeuralField, dict[str, float]]:
    """Train a field.

    Parameters
    ----------
    views : at least two, in order; every eighth is held out where there are eight or more.
    module : of as many images as are trained on; built as the options say unless given.
    progress : is given the step, the seconds, and the held-out PSNR in dB of each, now and then.

    Returns
    -------
    The field, and PSNR in dB of each held-out image by name.

    Raises
    ------
    DataError : too few images, or one does not fit its camera; no pixel may be used.
    """
    options = options or FieldTrainingOptions()
    started = time.monotonic()
    held_out = list(views[HELD_OUT_EVERY - 1 :: HELD_OUT_EVERY])
    trained = [view for view in views if not any(view is other for other in held_out)]
    if len(trained) < 2:
        raise DataError(f"{len(views)} images with poses and pixels are too few for a field")
    data = _Pixels(trained, options.max_side_px)
    device = pick_device(options.device)
    generator = torch.Generator().manual_seed(options.seed)
    if module is None:
        with torch.random.fork_rng([]):
            torch.manual_seed(options.seed)
            module = build_field(options.kind, len(trained))
    field = NeuralField(module.to(device), data.frame(), [view.name for view in trained])
    small = [_reduced_view(view, options.max_side_px) for view in held_out]
    optimizer = torch.optim.Adam(_groups(module), eps=1e-15, betas=(0.9, 0.99))
    rates = [group["lr"] for group in optimizer.param_groups]
    shown = max(options.steps // 5, 1)
    for step in range(options.steps):
        done = step / options.steps
        if options.minutes is not None:
            done = max(done, (time.monotonic() - started) / 60 / options.minutes)
        if done >= 1:
            break
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * _DECAY**done * min(1.0, (step + 1) / 50)
        rays, rgb = data.batch(field, options.rays_per_step, generator)
        with torch.autocast(device.type, torch.bfloat16, enabled=options.half_precision):
            rendered = module.render(rays, generator)
        loss = nerf_w_loss(rendered, rgb)
        if rays.depth is not None:
            error = (rendered.depth - rays.depth).abs() / rays.depth.clamp_min(1e-6)
            known = torch.where(rays.depth > 0, error.clamp(max=1.0), 0.0)
            loss = loss + options.depth_weight * known.mean()
        optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        optimizer.step()
        if progress is not None and (step + 1) % shown == 0 and step + 1 < options.steps:
            scores = [field.held_out_psnr(view) for view in small[:2]]
            progress(step + 1, time.monotonic() - started, scores)
    module.requires_grad_(False)
    return field, {view.name: field.held_out_psnr(view) for view in small}


def _groups(module: NerfW | TriPlane) -> list[dict[str, object]]:
    if isinstance(module, NerfW):
        return [{"params": list(module.parameters()), "lr": _NERF_RATE}]
    planes = list(module.planes)
    others = [value for name, value in module.named_parameters() if not name.startswith("planes")]
    return [{"params": planes, "lr": _PLANE_RATE}, {"params": others, "lr": _RATE}]


def _pixels(
    view: FieldView, max_side_px: int
) -> tuple[Camera, NDArray[np.uint8], NDArray[np.bool_], Floats | None]:
    """Reduced camera, colours (N, 3), usable pixels (N,) and depths (N,) of a view."""
    if view.image.shape != (view.camera.height, view.camera.width, 3):
        size = f"{view.camera.width}x{view.camera.height}"
        raise DataError(f"image {view.name}: {view.image.shape} does not fit a camera of {size}")
    camera = reduced(view.camera, max_side_px)
    pixels = camera.width, camera.height
    image = view.image
    if camera is not view.camera:
        image = np.asarray(cv2.resize(image, pixels, interpolation=cv2.INTER_AREA), np.uint8)
    usable = np.asarray(np.isfinite(pixel_rays(camera)).all(axis=1))
    if view.mask is not None:
        mask = cv2.resize(view.mask.astype(np.uint8), pixels, interpolation=cv2.INTER_AREA)
        usable = usable & (np.asarray(mask).ravel() > 0)
    depth = None
    if view.depth is not None:
        one = view.depth
        source = WarpSource(
            view.image,
            view.camera,
            view.cam_from_world,
            one.depth_m,
            one.camera,
            one.image_from_depth,
        )
        warped = warp_to_view(
            [source], view.camera, view.cam_from_world, scale=camera.width / view.camera.width
        )
        depth = warped.depth_m.ravel()
    return camera, image.reshape(-1, 3), usable, depth


def _reduced_view(view: FieldView, max_side_px: int) -> FieldView:
    camera, rgb, usable, _ = _pixels(view, max_side_px)
    shape = camera.height, camera.width
    return FieldView(
        view.name, rgb.reshape(*shape, 3), camera, view.cam_from_world, usable.reshape(shape)
    )


class _Pixels:
    """All pixels that are trained on, as one table."""

    def __init__(self, views: Sequence[FieldView], max_side_px: int) -> None:
        found = [_pixels(view, max_side_px) for view in views]
        self._cameras = list(dict.fromkeys(camera for camera, *_ in found))
        self._camera_of = np.array([self._cameras.index(camera) for camera, *_ in found])
        self._poses = [view.cam_from_world for view in views]
        self._starts = np.cumsum([0, *(len(rgb) for _, rgb, _, _ in found)])
        self._rgb = np.concatenate([rgb for _, rgb, _, _ in found])
        self._usable = np.flatnonzero(np.concatenate([usable for _, _, usable, _ in found]))
        if not len(self._usable):
            raise DataError("masks leave no pixel to train on")
        self._depth = None
        if any(depth is not None for *_, depth in found):
            self._depth = np.concatenate(
                [
                    np.zeros(len(rgb), np.float32) if depth is None else depth
                    for _, rgb, _, depth in found
                ]
            )
        self._rotations = np.stack([pose.rotation_matrix() for pose in self._poses])
        self._centres = np.stack([pose.center() for pose in self._poses])

    def frame(self) -> FieldFrame:
        """The frame about the cameras and what their depth shows; without, about the cameras."""
        low, high = self._centres.min(0), self._centres.max(0)
        spread = float(max((high - low).max(), 1e-6))
        near, far = 0.02 * spread, 20 * spread
        if self._depth is not None and (known := self._depth[self._depth > 0]).size:
            near, far = 0.5 * np.quantile(known, 0.01), 1.5 * np.quantile(known, 0.99)
            rows = self._usable[self._depth[self._usable] > 0]
            rows = rows[:: max(1, len(rows) // 20000)]
            image, rays = self._lines(rows)
            points = self._centres[image] + rays * self._depth[rows, None]
            low = np.minimum(low, np.quantile(points, 0.005, axis=0))
            high = np.maximum(high, np.quantile(points, 0.995, axis=0))
        else:
            low, high = low - spread, high + spread
        centre = 0.5 * (low + high)
        scale = 0.5 * float((high - low).max())
        x, y, z = centre.tolist()
        return FieldFrame(centre=(x, y, z), scale=scale, near=float(near), far=float(far))

    def _lines(self, rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Images (N,) of pixels, and their rays (N, 3) in the world."""
        image = np.searchsorted(self._starts, rows, side="right") - 1
        rays = np.empty((len(rows), 3))
        camera_of = self._camera_of[image]
        for number in np.unique(camera_of):
            which = camera_of == number
            inside = rows[which] - self._starts[image[which]]
            rays[which] = pixel_rays(self._cameras[number])[inside]
        return image, np.einsum("nj,njk->nk", rays, self._rotations[image])

    def batch(
        self, field: NeuralField, count: int, generator: torch.Generator
    ) -> tuple[Rays, torch.Tensor]:
        """Random rays with their embeddings, and the colours (N, 3) that are seen there."""
        drawn = torch.randint(len(self._usable), (count,), generator=generator).numpy()
        rows = self._usable[drawn]
        image, directions = self._lines(rows)
        frame, device = field.frame, field.device

        def tensor(values: NDArray[np.floating]) -> torch.Tensor:
            return torch.from_numpy(np.asarray(values, np.float32)).to(device)

        index = torch.from_numpy(image).to(device)
        module = field.module
        rays = Rays(
            tensor((self._centres[image] - frame.centre) / frame.scale),
            tensor(directions / frame.scale),
            frame.near,
            frame.far,
            None if module.appearance is None else module.appearance(index),
            None if module.transient is None else module.transient(index),
            None if self._depth is None else tensor(self._depth[rows]),
        )
        return rays, tensor(self._rgb[rows].astype(np.float32) / 255)

"""Radiance field of a map, which renders colour and depth from any pose.

It is trained by :mod:`~megloc_kapture.refinement.field_training`. As in NeRF-W's evaluation, the
appearance of a held-out image is fitted to its left half, and the error measured on its right half.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import PurePosixPath
from threading import Lock
from typing import Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import pixel_rays, reduced_camera
from megloc_kapture.geometry.warping import PosedImage, warp_to_view
from megloc_kapture.nets.radiance import NerfW, Rays, Rendered, TriPlane
from megloc_kapture.plugins import DepthView
from megloc_kapture.values import Camera, Options, RigidTransform

Kind = Literal["triplane", "nerfw"]
FieldModule = NerfW | TriPlane
Lights = Literal["image", "folder"]
Floats = NDArray[np.float32]
# rays rendered at once: they take two gigabytes on a GPU; on a CPU their samples fit the cache
_CHUNK, _CPU_CHUNK = 4096, 512
# fit of an appearance embedding: Adam's rate, steps, rays per step, and rays to draw from
_FIT_RATE, _FIT_STEPS, _FIT_RAYS, _FIT_OF = 0.1, 20, 512, 2048


class FieldFrame(Options):
    """Frame of a field: ``x_field = (x_world - centre) / scale``.

    ``near`` and ``far`` are depths in the map's unit.
    """

    centre: tuple[float, float, float]
    scale: float = Field(gt=0)
    near: float = Field(gt=0)
    far: float = Field(gt=0)


def build_field(kind: Kind, num_images: int, num_lights: int) -> FieldModule:
    return (NerfW if kind == "nerfw" else TriPlane)(num_images, num_lights)


def light_rows(images: Sequence[str], lights: Lights) -> list[int]:
    """Return each image's row of the appearance embedding: per image or per folder."""
    names = [image if lights == "image" else str(PurePosixPath(image).parent) for image in images]
    row_of = {name: row for row, name in enumerate(dict.fromkeys(names))}
    return [row_of[name] for name in names]


class NeuralField:
    """A field, its frame and its training images.

    ``light_rows`` are the images' rows of the appearance embedding.
    """

    def __init__(
        self,
        module: FieldModule,
        frame: FieldFrame,
        images: Sequence[str],
        light_rows: Sequence[int],
    ) -> None:
        self.module, self.frame, self.images = module, frame, tuple(images)
        self.device = next(module.parameters()).device
        # threads share the field, and the memory of a GPU may hold the samples of one chunk only
        self._rendering = Lock() if self.device.type == "cuda" else nullcontext()
        self.light_rows = torch.tensor(light_rows, device=self.device)

    def rays(self, camera: Camera, cam_from_world: RigidTransform) -> Rays:
        """Return rays (H * W,) through the pixel centres of a view, row by row."""
        directions = pixel_rays(camera) @ cam_from_world.rotation_matrix()
        return self.rays_from(cam_from_world.center(), directions)

    def rays_from(
        self, centres: NDArray[np.float64], directions: NDArray[np.float64], **more: Any
    ) -> Rays:
        """Return rays from world points (N, 3), or (3,), along directions (N, 3) of unit depth."""
        frame = self.frame
        along = self.tensor(directions / frame.scale)
        origins = self.tensor((centres - frame.centre) / frame.scale).expand_as(along)
        return Rays(origins, along, frame.near, frame.far, **more)

    def appearance_of(self, image: str) -> torch.Tensor:
        """Return the appearance embedding (A,) of a training image."""
        if image not in self.images:
            raise DataError(f"the field was not trained on image {image!r}")
        row = self.light_rows[self.images.index(image)]
        return self.module.appearance.weight[row].detach()

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        cam_from_world: RigidTransform,
        *,
        appearance: torch.Tensor | None = None,
        max_side_px: int | None = None,
    ) -> tuple[PosedImage, Floats]:
        """Render a view without transient objects; ``appearance`` (A,) is the mean by default.

        The camera is reduced to ``max_side_px``. Also returns the depth, float32 (H, W) along the
        optical axis in the map's unit; 0 where mostly empty.
        """
        camera = reduced_camera(camera, max_side_px or max(camera.width, camera.height))
        shape = camera.height, camera.width
        rendered = self.render_rays(self.rays(camera, cam_from_world), appearance)
        rgb = (rendered.rgb * 255).round().clamp(0, 255).byte().cpu().numpy().reshape(*shape, 3)
        depth = torch.where(rendered.opacity > 0.5, rendered.depth, 0.0).cpu().numpy()
        depth_m = depth.reshape(shape).astype(np.float32)
        view = DepthView(camera, depth_m, RigidTransform.identity())
        return PosedImage(rgb, camera, cam_from_world, view), depth_m

    def render_rays(self, rays: Rays, appearance: torch.Tensor | None = None) -> Rendered:
        parts, size = [], _CPU_CHUNK if self.device.type == "cpu" else _CHUNK
        for start in range(0, len(rays.origins), size):
            part = select(rays, slice(start, start + size))
            if appearance is not None:
                part = replace(part, appearance=appearance.expand(len(part.origins), -1))
            with self._rendering:
                parts.append(self.module.render(part))
        names = ("rgb", "depth", "opacity", "beta", "weights")
        joined = {
            name: torch.cat([getattr(rendered, name) for rendered in parts]) for name in names
        }
        return replace(parts[0], coarse_rgb=None, **joined)

    def fit_appearance(self, rays: Rays, rgb: torch.Tensor) -> torch.Tensor:
        """Fit an appearance embedding (A,) to the rays' colours (N, 3)."""
        generator = torch.Generator().manual_seed(0)
        drawn = torch.randperm(len(rgb), generator=generator)[:_FIT_OF].to(self.device)
        rays, rgb = select(rays, drawn), rgb[drawn]
        with torch.no_grad():
            seen = self.render_rays(rays)
            rays = replace(rays, depth=torch.where(seen.opacity > 0.5, seen.depth, 0.0))
        fitted = self.module.appearance.weight.detach().mean(0).clone().requires_grad_()
        optimizer = torch.optim.Adam([fitted], lr=_FIT_RATE)
        for _ in range(_FIT_STEPS):
            rows = torch.randint(len(rgb), (min(_FIT_RAYS, len(rgb)),), generator=generator)
            rows = rows.to(self.device)
            part = replace(select(rays, rows), appearance=fitted.expand(len(rows), -1))
            off = self.module.render(part).rgb - rgb[rows]
            # the loss is linear for errors above a tenth of full scale, to limit the effect of
            # transient objects on the appearance
            loss = torch.nn.functional.huber_loss(off, torch.zeros_like(off), delta=0.1)
            (fitted.grad,) = torch.autograd.grad(loss, [fitted])
            optimizer.step()
        return fitted.detach()

    def fitted_appearance(self, view: PosedImage, max_side_px: int) -> torch.Tensor | None:
        camera, rgb, usable, _ = pixels_of(view, max_side_px)
        rows = torch.from_numpy(np.flatnonzero(usable)).to(self.device)
        if not len(rows):
            return None
        rays = select(self.rays(camera, view.cam_from_world), rows)
        return self.fit_appearance(rays, self.tensor(rgb.astype(np.float32) / 255)[rows])

    def held_out_psnr(self, view: PosedImage) -> float:
        """Return the PSNR in dB on an image's right half, with the appearance of its left half.

        NaN if a half has no usable pixel.
        """
        camera, rgb, usable, _ = pixels_of(view, max(view.camera.width, view.camera.height))
        rays = self.rays(camera, view.cam_from_world)
        left = np.arange(camera.width * camera.height) % camera.width < camera.width // 2
        seen = self.tensor(rgb.astype(np.float32) / 255)
        ours, judged = (
            torch.from_numpy(np.flatnonzero(usable & half)).to(self.device)
            for half in (left, ~left)
        )
        if not len(ours) or not len(judged):
            return float("nan")
        appearance = self.fit_appearance(select(rays, ours), seen[ours])
        with torch.no_grad():
            rendered = self.render_rays(select(rays, judged), appearance).rgb
        error = torch.square(rendered.clamp(0, 1) - seen[judged]).mean()
        return float(-10 * torch.log10(error.clamp_min(1e-10)))

    def tensor(self, values: NDArray[np.floating]) -> torch.Tensor:
        return torch.from_numpy(np.asarray(values, np.float32)).to(self.device)


def select(rays: Rays, rows: slice | torch.Tensor) -> Rays:
    chosen = {
        name: value[rows]
        for name in ("origins", "directions", "appearance", "transient", "depth")
        if (value := getattr(rays, name)) is not None
    }
    return replace(rays, **chosen)


def pixels_of(
    view: PosedImage, max_side_px: int
) -> tuple[Camera, NDArray[np.uint8], NDArray[np.bool_], Floats | None]:
    """Return a reduced view: camera, colours (N, 3), usable pixels (N,) and depths (N,)."""
    camera = reduced_camera(view.camera, max_side_px)
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
        scale, unmasked = camera.width / view.camera.width, replace(view, mask=None)
        warped = warp_to_view([unmasked], view.camera, view.cam_from_world, scale=scale)
        depth = warped.depth_m.ravel()
    return camera, image.reshape(-1, 3), usable, depth


def reduced_view(view: PosedImage, max_side_px: int) -> PosedImage:
    camera, rgb, usable, _ = pixels_of(view, max_side_px)
    shape = camera.height, camera.width
    image, mask = rgb.reshape(*shape, 3), usable.reshape(shape)
    return PosedImage(image, camera, view.cam_from_world, mask=mask, name=view.name)

"""Training of a neural field on the posed images of a map.

The loss is NeRF-W's (:func:`~megloc_kapture.nets.radiance.nerf_w_loss`) on random pixels, with a
depth term for images with depth.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.geometry.warping import PosedImage
from megloc_kapture.nets.radiance import NerfW, Rays, nerf_w_loss
from megloc_kapture.nets.runtime import NetworkOptions, load_state, pick_device, state_bytes
from megloc_kapture.refinement.neural_field import (
    FieldFrame,
    FieldModule,
    Kind,
    Lights,
    NeuralField,
    build_field,
    light_rows,
    pixels_of,
    reduced_view,
)

# Adam's initial rates for planes, small networks and NeRF-W; they decay to a thirtieth
_PLANE_RATE, _RATE, _NERF_RATE = 2e-2, 5e-3, 5e-4
_DECAY = 1 / 30
_KEEP_EVERY = 200
_DEPTH_WEIGHT = 5.5  # of the relative depth error, added to NeRF-W's loss


class FieldTrainingOptions(NetworkOptions):
    kind: Kind = Field(
        default="triplane",
        description="triplane: minutes on a CPU; nerfw: for a GPU",
    )
    steps: int = Field(default=4000, gt=0, description="number of training steps")
    minutes: float | None = Field(
        default=None,
        gt=0,
        description="time limit; results are reproducible only without it",
    )
    rays_per_step: int = Field(
        default=2048, gt=0, description="number of rays, through random pixels of all images"
    )
    max_side_px: int = Field(
        default=320,
        ge=16,
        description="longer side of the training images; larger ones are reduced",
    )
    held_out_every: int = Field(default=8, ge=0, description="hold out every N-th image; 0: none")
    lights: Lights = Field(
        default="image", description="one appearance per image, or per folder of images"
    )
    compiled: bool = Field(
        default=False,
        description="use torch.compile, which takes minutes at first and needs a C compiler",
    )
    seed: int = Field(default=0, ge=0)


class FieldTrainer:
    """Trainer of a field on ``views``, of which every ``held_out_every``-th is held out."""

    def __init__(self, views: Sequence[PosedImage], options: FieldTrainingOptions) -> None:
        self.options = options
        every = options.held_out_every
        held_out = list(views[every - 1 :: every]) if every else []
        names = {view.name for view in held_out}
        trained = [view for view in views if view.name not in names]
        if len(trained) < 2:
            raise DataError(f"{len(views)} images with poses and pixels are too few for a field")
        images = [view.name for view in trained]
        rows = light_rows(images, options.lights)
        self._data = _Pixels(trained, options.max_side_px)
        frame = self._data.frame()
        with torch.random.fork_rng([]):
            torch.manual_seed(options.seed)
            module = build_field(options.kind, len(images), max(rows) + 1)
        module = module.to(pick_device(options.device))
        self._field = NeuralField(module, frame, images, rows)
        self._render = torch.compile(module.render) if options.compiled else module.render
        self._held_out = [reduced_view(view, options.max_side_px) for view in held_out]
        self._optimizer = torch.optim.Adam(_groups(module), eps=1e-15, betas=(0.9, 0.99))
        self._rates = [float(group["lr"]) for group in self._optimizer.param_groups]
        self._step, self._seconds = 0, 0.0

    def resume(self, state: bytes, path: Path) -> None:
        """Restore a state passed to ``keep``; DataError if damaged or from another run."""
        content = load_state(state, path, self._field.module, self._optimizer)
        if content.get("training") != self._fingerprint:
            raise DataError(
                "is from a training run with different options or images; -f starts over", path=path
            )
        self._step, self._seconds = content["step"], float(content["seconds"])

    @cached_property
    def _fingerprint(self) -> str:
        options = self.options.model_dump_json(exclude={"minutes"})
        return hashlib.sha256(f"{options} {self._field.images}".encode()).hexdigest()

    def train(
        self,
        *,
        progress: Callable[[int, float, list[float]], None] | None = None,
        keep: Callable[[bytes], None] | None = None,
    ) -> tuple[NeuralField, dict[str, float]]:
        """Train to the last step or time limit; return the field and the held-out PSNR in dB.

        ``progress`` receives the step, the seconds and the PSNR in dB of the first two held-out
        images; ``keep`` receives the state.
        """
        options, field = self.options, self._field
        start_s = time.monotonic() - self._seconds
        report_every = max(options.steps // 5, 1)
        generator = torch.Generator()
        for step in range(self._step, options.steps):
            progress_share, self._seconds = step / options.steps, time.monotonic() - start_s
            if options.minutes is not None:
                progress_share = max(progress_share, self._seconds / 60 / options.minutes)
            if progress_share >= 1:
                break
            for group, rate in zip(self._optimizer.param_groups, self._rates, strict=True):
                group["lr"] = rate * _DECAY**progress_share * min(1.0, (step + 1) / 50)
            seeds = np.random.SeedSequence([options.seed, step])
            generator.manual_seed(int(seeds.generate_state(1, np.uint64)[0]))
            with _compiling() if options.compiled else nullcontext():
                self._learn(generator)
            self._step = step + 1
            if self._step == options.steps:
                break
            if keep is not None and self._step % _KEEP_EVERY == 0:
                counters = {
                    "step": self._step,
                    "seconds": self._seconds,
                    "training": self._fingerprint,
                }
                keep(state_bytes(field.module, self._optimizer, counters))
            if progress is not None and self._step % report_every == 0:
                scores = [field.held_out_psnr(view) for view in self._held_out[:2]]
                progress(self._step, self._seconds, scores)
        field.module.requires_grad_(False)
        return field, {view.name: field.held_out_psnr(view) for view in self._held_out}

    def _learn(self, generator: torch.Generator) -> None:
        options, device = self.options, self._field.device
        rays, rgb = self._data.batch(self._field, options.rays_per_step, generator)
        with torch.autocast(device.type, torch.bfloat16, enabled=options.half_precision):
            rendered = self._render(rays, generator)
        loss = nerf_w_loss(rendered, rgb)
        if (depth := rays.depth) is not None:
            error = (rendered.depth - depth).abs() / depth.clamp_min(1e-6)
            known = torch.where(depth > 0, error.clamp(max=1.0), 0.0)
            loss = loss + _DEPTH_WEIGHT * known.mean()
        self._optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        self._optimizer.step()


@contextmanager
def _compiling() -> Iterator[None]:
    """Enable torch.compile, with its cache keyed by the processor's instruction set.

    torch caches graphs by content only: a graph compiled for AVX2 writes out of bounds with
    AVX-512.
    """
    from torch._dynamo.exc import TorchDynamoException

    config: Any = torch.compiler.config
    instructions = torch.backends.cpu.get_cpu_capability()
    try:
        with config.patch(cache_key_tag=f"{config.cache_key_tag} {instructions}"):
            yield
    except TorchDynamoException as error:
        reason = str(error).strip().partition("\n")[0]
        raise OptionError(f"compiled: torch.compile fails here: {reason}") from error


def _groups(module: FieldModule) -> list[dict[str, object]]:
    if isinstance(module, NerfW):
        return [{"params": list(module.parameters()), "lr": _NERF_RATE}]
    planes = list(module.planes)
    others = [value for name, value in module.named_parameters() if not name.startswith("planes")]
    return [{"params": planes, "lr": _PLANE_RATE}, {"params": others, "lr": _RATE}]


class _Pixels:
    def __init__(self, views: Sequence[PosedImage], max_side_px: int) -> None:
        pixels = [pixels_of(view, max_side_px) for view in views]
        self._cameras = list(dict.fromkeys(camera for camera, *_ in pixels))
        number_of = {camera: number for number, camera in enumerate(self._cameras)}
        self._camera_of = np.array([number_of[camera] for camera, *_ in pixels])
        self._poses = [view.cam_from_world for view in views]
        self._starts = np.cumsum([0, *(len(rgb) for _, rgb, _, _ in pixels)])
        self._rgb = np.concatenate([rgb for _, rgb, _, _ in pixels])
        self._usable = np.flatnonzero(np.concatenate([usable for _, _, usable, _ in pixels]))
        if not len(self._usable):
            raise DataError("masks leave no pixel to train on")
        self._depth = None
        if any(depth is not None for *_, depth in pixels):
            depths = [np.zeros(len(rgb), np.float32) if z is None else z for _, rgb, _, z in pixels]
            self._depth = np.concatenate(depths)
        self._rotations = np.stack([pose.rotation_matrix() for pose in self._poses])
        self._centres = np.stack([pose.center() for pose in self._poses])

    def frame(self) -> FieldFrame:
        low, high = self._centres.min(0), self._centres.max(0)
        spread = float(max((high - low).max(), 1e-6))
        near, far = 0.02 * spread, 20 * spread
        if self._depth is not None and (known := self._depth[self._depth > 0]).size:
            near, far = float(0.5 * np.quantile(known, 0.01)), float(1.5 * np.quantile(known, 0.99))
            rows = self._usable[self._depth[self._usable] > 0]
            rows = rows[:: max(1, len(rows) // 20000)]
            image, rays = self._world_rays(rows)
            points = self._centres[image] + rays * self._depth[rows, None]
            low = np.minimum(low, np.quantile(points, 0.005, axis=0))
            high = np.maximum(high, np.quantile(points, 0.995, axis=0))
        else:
            low, high = low - spread, high + spread
        centre = 0.5 * (low + high)
        scale = 0.5 * float((high - low).max())
        x, y, z = centre.tolist()
        return FieldFrame(centre=(x, y, z), scale=scale, near=near, far=far)

    def _world_rays(self, rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        image = np.searchsorted(self._starts, rows, side="right") - 1
        rays = np.empty((len(rows), 3))
        camera_of = self._camera_of[image]
        for number in np.unique(camera_of):
            of_camera = camera_of == number
            camera = self._cameras[number]
            y, x = np.divmod(rows[of_camera] - self._starts[image[of_camera]], camera.width)
            # compute rays of these pixels only, since a map may have as many cameras as images
            rays[of_camera] = bearing_rays(camera, np.stack([x + 0.5, y + 0.5], axis=1))
        return image, np.einsum("nj,njk->nk", rays, self._rotations[image])

    def batch(
        self, field: NeuralField, count: int, generator: torch.Generator
    ) -> tuple[Rays, torch.Tensor]:
        chosen = torch.randint(len(self._usable), (count,), generator=generator).numpy()
        rows = self._usable[chosen]
        image, directions = self._world_rays(rows)
        index = torch.from_numpy(image).to(field.device)
        rays = field.rays_from(
            self._centres[image],
            directions,
            appearance=field.module.appearance(field.light_rows[index]),
            transient=field.module.transient(index),
            depth=None if self._depth is None else field.tensor(self._depth[rows]),
        )
        return rays, field.tensor(self._rgb[rows].astype(np.float32) / 255)

"""Neural fields of a ray-cast room with known light, moving objects, depth and poses."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import room  # noqa: E402

from megloc_kapture.errors import DataError  # noqa: E402
from megloc_kapture.geometry.warping import PosedImage  # noqa: E402
from megloc_kapture.nets import radiance  # noqa: E402
from megloc_kapture.pipeline.executors import single_threaded  # noqa: E402
from megloc_kapture.plugins import DepthView  # noqa: E402
from megloc_kapture.refinement import field_training  # noqa: E402
from megloc_kapture.refinement.field_training import FieldTrainer, FieldTrainingOptions  # noqa: E402
from megloc_kapture.refinement.neural_field import NeuralField, light_rows, pixels_of  # noqa: E402
from megloc_kapture.values import Camera, RigidTransform  # noqa: E402

SMALL = Camera("PINHOLE", 32, 24, (22.0, 22.0, 16.0, 12.0))
QUICK = FieldTrainingOptions(steps=8, rays_per_step=128, device="cpu")
IDENTITY = RigidTransform.identity()


def state_of(given: list[PosedImage], options: FieldTrainingOptions) -> dict[str, Any]:
    return FieldTrainer(given, options).train()[0].module.state_dict()


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Train with a single thread: equal bytes need it."""
    with single_threaded():
        yield


@pytest.fixture(autouse=True)
def coarse_planes(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce the planes in quick tests to a hundredth: the optimizer takes most of a step."""
    if request.node.get_closest_marker("slow") is None:
        monkeypatch.setattr(radiance, "_RESOLUTIONS", (16, 32, 48))


def views(
    count: int, camera: Camera = SMALL, *, seed: int = 1, depth: bool = True, moving: bool = False
) -> list[PosedImage]:
    result = []
    for number, pose in enumerate(room.poses(count, seed)):
        mover = number if moving and number % 5 < 3 else None
        seen = room.render(pose, camera=camera, light=number % 2, moving=mover)
        # depth of the empty room, as if measured at another time
        alone = room.render(pose, camera=camera).depth_m
        known = DepthView(camera, alone, IDENTITY) if depth else None
        result.append(PosedImage(seen.image, camera, pose, known, name=f"{number:03}.png"))
    return result


def depth_error(field: NeuralField, tests: list[PosedImage]) -> float:
    errors = []
    for view in tests:
        assert view.depth is not None
        known = view.depth.depth_m
        _, result = field.render(view.camera, view.cam_from_world)
        errors.append(np.abs(result - known) / known)
    return float(np.median(errors))


def test_a_small_field_learns_the_room_deterministically() -> None:
    seen: list[tuple[int, list[float]]] = []
    options = FieldTrainingOptions(steps=60, rays_per_step=256, device="cpu")

    def progress(step: int, seconds: float, psnr_db: list[float]) -> None:
        seen.append((step, psnr_db))

    field, psnr = FieldTrainer(views(8), options).train(progress=progress)
    assert set(psnr) == {"007.png"} and len(field.images) == 7
    # an image of one colour has 14 dB
    assert min(psnr.values()) > 16 and depth_error(field, views(4)) < 0.2
    assert [step for step, _ in seen] == list(range(12, 60, 12))
    assert all(len(values) == 1 for _, values in seen)
    brief = QUICK.model_copy(update={"steps": 3})
    first, second = (state_of(views(5), brief) for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)
    changed = state_of(views(5), brief.model_copy(update={"seed": 1}))
    assert not torch.equal(changed["planes.0"], first["planes.0"])


def test_half_precision_learns_nearly_the_same() -> None:
    brief = QUICK.model_copy(update={"steps": 2})
    half = brief.model_copy(update={"half_precision": True})
    fields = [FieldTrainer(views(5), each).train()[0] for each in (brief, half)]
    exact, near = (field.module.state_dict() for field in fields)
    assert any(not torch.equal(exact[name], near[name]) for name in exact)
    images = [field.render(SMALL, IDENTITY)[0].image for field in fields]
    assert np.abs(np.subtract(*np.float64(images))).mean() < 8


@pytest.mark.slow
def test_compiled_learns_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    brief = QUICK.model_copy(update={"steps": 2})
    compiled = brief.model_copy(update={"compiled": True})
    one, other = (state_of(views(5), each) for each in (brief, compiled))
    for name in one:
        torch.testing.assert_close(one[name], other[name], atol=5e-3, rtol=0)


_COMPILE = """
import torch
from megloc_kapture.refinement.field_training import _compiling

with _compiling():
    torch.compile(lambda values: (2 * values).sin())(torch.ones(64))
"""


@pytest.mark.slow
def test_a_missing_compiler_is_an_option_error(tmp_path: Path) -> None:
    environment = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": str(tmp_path), "CXX": "/nowhere/g++"}
    command = [sys.executable, "-c", _COMPILE]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert re.search("OptionError: compiled: .*No working C.. compiler.*$", done.stderr)


def test_resumed_training_equals_uninterrupted_training(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(field_training, "_KEEP_EVERY", 3)
    path, states = Path("field.state.pt"), list[bytes]()
    whole, _ = FieldTrainer(views(5), QUICK).train(keep=states.append)
    assert len(states) == 2  # after three steps and after six of eight
    trainer = FieldTrainer(views(5), QUICK)
    trainer.resume(states[0], path)
    resumed, _ = trainer.train(keep=states.append)
    expected = whole.module.state_dict()
    assert all(torch.equal(expected[n], v) for n, v in resumed.module.state_dict().items())
    with pytest.raises(DataError, match=r"state\.pt: .* -f starts over"):
        FieldTrainer(views(4), QUICK).resume(states[0], path)
    with pytest.raises(DataError, match=r"state\.pt: is damaged or from"):
        trainer.resume(states[0][:-100], path)


def test_images_of_a_folder_may_share_their_light() -> None:
    given = [replace(v, name=f"{n % 2}/{v.name}") for n, v in enumerate(views(6))]
    options = QUICK.model_copy(update={"lights": "folder", "held_out_every": 2, "steps": 2})
    field, psnr = FieldTrainer(given, options).train()
    assert field.images == ("0/000.png", "0/002.png", "0/004.png") and len(psnr) == 3
    assert len(field.module.appearance.weight) == 1
    field, psnr = FieldTrainer(given, options.model_copy(update={"held_out_every": 0})).train()
    assert len(field.images) == 6 and not psnr
    assert len(field.module.transient.weight) == 6
    lights = {name: field.appearance_of(name) for name in field.images}
    assert torch.equal(lights["0/000.png"], lights["0/004.png"])
    assert not torch.equal(lights["0/000.png"], lights["1/001.png"])
    assert light_rows(["b/1", "a/1", "b/2", "c"], "folder") == [0, 1, 0, 2]


def test_masked_pixels_are_ignored() -> None:
    plain = views(4)
    mask = np.ones((24, 32), bool)
    mask[:, :10] = False
    spoiled, masked = [], []
    for view in plain:
        image = view.image.copy()
        image[~mask] = 255
        arguments = (view.camera, view.cam_from_world, view.depth, mask, view.name)
        masked.append(PosedImage(view.image, *arguments))
        spoiled.append(PosedImage(image, *arguments))
    first, second, whole = (
        state_of(given, QUICK.model_copy(update={"steps": 2})) for given in (masked, spoiled, plain)
    )
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not torch.equal(first["planes.0"], whole["planes.0"])


def test_depth_of_another_camera_is_transformed() -> None:
    plain = views(4)
    finer = Camera("PINHOLE", 64, 48, (44.0, 44.0, 32.0, 24.0))
    shift = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.03, 0.0, 0.0))
    moved = []
    for view in plain:
        assert view.depth is not None
        seen = room.render(shift.inverse() @ view.cam_from_world, camera=finer)
        depth = DepthView(finer, seen.depth_m, shift)
        moved.append(replace(view, depth=depth))
    for view, other in zip(plain, moved, strict=True):
        direct, brought = pixels_of(view, 32)[3], pixels_of(other, 32)[3]
        assert direct is not None and brought is not None
        both = (direct > 0) & (brought > 0)
        assert both.mean() > 0.75
        assert np.median(np.abs(brought[both] / direct[both] - 1)) < 0.01


def test_invalid_training_is_refused() -> None:
    few = views(1)
    with pytest.raises(DataError, match="too few"):
        FieldTrainer(few, QUICK).train()
    (view,) = few
    hidden = replace(view, mask=np.zeros((24, 32), bool))
    with pytest.raises(DataError, match="no pixel"):
        FieldTrainer([hidden, hidden], QUICK).train()
    field, _ = FieldTrainer(views(4, depth=False), QUICK.model_copy(update={"steps": 1})).train()
    with pytest.raises(DataError, match="not trained on image 'x'"):
        field.appearance_of("x")


@pytest.mark.slow
def test_two_lights_and_moving_objects_do_not_blur_the_field() -> None:
    clean = views(10, room.CAMERA, seed=2)
    trained = views(40, room.CAMERA, moving=True)
    options = FieldTrainingOptions(steps=1000, rays_per_step=1024, device="cpu")
    field, _ = FieldTrainer(trained, options).train()
    psnr_db = float(np.mean([field.held_out_psnr(view) for view in clean]))
    error = depth_error(field, clean)
    print(f"PSNR {psnr_db:.1f} dB, depth {error}")
    assert psnr_db >= 24
    assert error < 0.02

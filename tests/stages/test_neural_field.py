"""Poses refined by rendering a neural field, against the exact poses in a ray-cast room."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import room
from numpy.typing import NDArray
from poses import displaced

from megloc_kapture.errors import OptionError
from megloc_kapture.geometry.poses import movement
from megloc_kapture.geometry.warping import PosedImage
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import POSE_REFINERS, DepthView, PoseRefinement
from megloc_kapture.values import Camera, RigidTransform

pytest.importorskip("torch")

from megloc_kapture.refinement.acceptance import RenderingOptions  # noqa: E402
from megloc_kapture.refinement.rendering import RenderingRefinement  # noqa: E402
from megloc_kapture.stages import neural_field  # noqa: E402

IDENTITY = RigidTransform.identity()
LARGER = Camera("PINHOLE", 288, 216, (198.0, 198.0, 144.0, 108.0))


class Query:
    """A ranking scene with one query image."""

    def __init__(self, image: NDArray[np.uint8]) -> None:
        self.image = image

    def query_image(self, name: str) -> NDArray[np.uint8]:
        return self.image

    def query_mask(self, name: str) -> None:
        return None


class ExactField:
    """A field that renders the room without error, in its first light."""

    def fitted_appearance(self, *_: Any) -> None:
        return None

    def render(
        self, camera: Camera, pose: RigidTransform, **_: Any
    ) -> tuple[PosedImage, NDArray[np.float32]]:
        seen = room.render(pose, camera=camera)
        depth = DepthView(camera, seen.depth_m, IDENTITY)
        return PosedImage(seen.image, camera, pose, depth), seen.depth_m


def refined(
    field: Path | str, camera: Camera, image: NDArray[np.uint8], start: RigidTransform
) -> PoseRefinement:
    refiner = load_plugin(POSE_REFINERS, "field", {"field": str(field)})
    found = refiner.refine("query", camera, start, [], Query(image))
    assert isinstance(found, PoseRefinement)
    return found


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neural_field, "open_field", lambda *_: ExactField())


def test_a_pose_off_by_ten_centimetres_is_refined_to_millimetres(exact: None) -> None:
    truth = room.poses(2, 4)[1]
    seen = room.render(truth, camera=LARGER, light=1, moving=1)
    found = refined("exact", LARGER, seen.image, displaced(truth, 0))
    error_m, error_deg = movement(truth, found.cam_from_world)
    assert found.accepted and error_m < 0.005 and error_deg < 0.1, (found, error_m, error_deg)
    assert found.covariance is not None
    assert found.measures["moved_m"] == pytest.approx(0.1, abs=0.01)


def test_dissimilar_images_and_exact_poses_keep_their_pose(exact: None) -> None:
    truth = room.poses(1, 4)[0]
    noise = np.random.default_rng(0).integers(0, 255, (216, 288, 3), np.uint8)
    found = refined("exact", LARGER, noise, truth)
    assert not found.accepted and found.cam_from_world == truth and found.reason
    # an exact pose is kept, also within rounding
    seen = room.render(truth, camera=LARGER).image
    for start in (truth, displaced(truth, 0, 1e-9, 1e-8)):
        same = refined("exact", LARGER, seen, start)
        assert not same.accepted and same.cam_from_world == start
    with pytest.raises(OptionError, match="train-field"):
        load_plugin(POSE_REFINERS, "field")


def test_appearance_and_acceptance_use_different_halves_of_the_image(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fitted: list[NDArray[np.bool_]] = []

    class Spied(ExactField):
        def fitted_appearance(self, view: Any, *_: Any) -> None:
            fitted.append(view.mask)

    judged: list[NDArray[np.bool_]] = []

    class SpiedRefinement(RenderingRefinement):
        def judge(self, pose: Any, which: Any = None) -> PoseRefinement:
            judged.append(which)
            return super().judge(pose, which)

    monkeypatch.setattr(neural_field, "open_field", lambda *_: Spied())
    monkeypatch.setattr(neural_field, "RenderingRefinement", SpiedRefinement)
    truth = room.poses(1, 4)[0]
    start = displaced(truth, 0)
    seen = room.render(truth, camera=LARGER)
    image, depth = seen.image, seen.depth_m
    whole = refined("exact", LARGER, image, start)
    half = fitted[0]
    assert judged and all((one == ~half).all() for one in judged)
    assert whole.accepted and half.mean() == pytest.approx(0.5, abs=0.05)
    reference = PosedImage(image, LARGER, truth, DepthView(LARGER, depth, IDENTITY))
    options = RenderingOptions()
    noise = np.random.default_rng(0).integers(0, 255, image.shape, np.uint8)
    query = PosedImage(np.where(half[..., None], noise, image), LARGER, start)
    by_one, by_other, by_all = (
        RenderingRefinement(query, [reference], options).judge(truth, which)
        for which in (~half, half, None)
    )
    assert by_one.accepted and not by_other.accepted, (by_one, by_other)
    assert by_other.measures["correlation_after"] < 0.2 < by_one.measures["correlation_after"]
    assert by_one.measures["points"] < 0.6 * by_all.measures["points"]

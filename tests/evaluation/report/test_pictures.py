"""Images with masks in the report: which, what is said of them, and what is drawn."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from megloc_kapture.evaluation.evaluate import results_without_truth
from megloc_kapture.evaluation.protocols import benchmark_of
from megloc_kapture.evaluation.report.document import Paragraph, Pictures
from megloc_kapture.evaluation.report.pictures import SegmentedClasses, class_colors, mask_blocks
from megloc_kapture.evaluation.report.reports import render_report
from megloc_kapture.evaluation.results import ResultContext, context_of
from megloc_kapture.evaluation.scoring import evaluate_poses
from megloc_kapture.io.dataset_tables import Protocol, write_protocol
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import FeatureConfig, FeatureWriter, KaptureFolder
from megloc_kapture.io.tables import write_mask_counts

CLASSES = ("road", "building", "sky", "person", "car")
WIDTH, HEIGHT = 640, 480  # of the camera that the kaptures have
ROAD, BUILDING, SKY, CAR = 0, 1, 2, 4
# rows and columns of the car, which the mask hides
CAR_PLACE = np.s_[300:420, 160:480]


def labels() -> np.ndarray:
    found = np.full((HEIGHT, WIDTH), BUILDING, np.uint8)
    found[:120], found[360:] = SKY, ROAD
    found[CAR_PLACE] = CAR
    return found


def add_image(root: Path, features: FeatureWriter, image: str, seed: int) -> np.ndarray:
    """Image, classes, mask, and keypoints beside the mask; returns the keypoints."""
    rng = np.random.default_rng(seed)
    sensors = root / "sensors"
    write_image(sensors / "records_data" / image, np.full((HEIGHT, WIDTH, 3), 200, np.uint8))
    write_image(sensors / "classes" / f"{image}.png", labels())
    mask = np.where(labels() == CAR, 0, 255).astype(np.uint8)
    write_image(sensors / "masks" / f"{image}.png", mask)
    xy = rng.uniform((0, 0), (WIDTH, 300), (50, 2)).astype(np.float32)
    features.write(image, xy)
    return xy


@pytest.fixture
def workspace(tmp_path: Path, kaptures: Callable[..., Path]) -> Path:
    root, names = tmp_path / "runs", [f"q{number:02d}.jpg" for number in range(10)]
    write_protocol(root / "megloc", Protocol())
    for folder in ("query", "localized"):
        kaptures(root / folder, names, {})
    prepared = kaptures(root / "preprocessed/query", names, {})
    config = FeatureConfig("x", np.dtype("<f4"), 2)
    with FeatureWriter(root, "keypoints", "x", config, orphan=True) as keypoints:
        for seed, image in enumerate(names):
            add_image(prepared, keypoints, image, seed)
    content = {"classes": CLASSES, "dynamic": ["car", "person"]}
    (prepared / "sensors/classes/classes.json").write_text(json.dumps(content))
    write_mask_counts(root, "x", dict.fromkeys(names, 17))
    return root


def decoded(address: str) -> np.ndarray:
    content = base64.b64decode(address.split(",", 1)[1])
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]


def folder_of(workspace: Path) -> KaptureFolder:
    (folder,) = context_of(workspace / "localized").masked
    return folder


def masked(folder: KaptureFolder) -> list[Pictures]:
    return [block for block in mask_blocks([folder]) if isinstance(block, Pictures)]


def address_of(panel: object) -> str:
    (found,) = re.findall(r'(?:src|href)="(data:[^"]+)"', str(panel))
    return found


def test_a_few_images_are_chosen_evenly_and_what_is_removed_is_said(workspace: Path) -> None:
    folder = folder_of(workspace)
    assert folder.root == workspace / "preprocessed/query"
    # the middles of three thirds of ten
    assert [one.name for one in masked(folder)] == ["q01.jpg", "q05.jpg", "q08.jpg"]
    share = 100 * 120 * 320 / (WIDTH * HEIGHT)
    expected = f"{share:.1f} % masked, 50 keypoints of x kept, 17 removed"
    assert all(one.facts == (expected,) for one in masked(folder))
    # where they were found without the mask, that is said too
    config = FeatureConfig("a", np.dtype("<f4"), 2)
    with FeatureWriter(workspace, "keypoints", "a", config, orphan=True) as keypoints:
        corners = [(160.0, 300.0), (479.9, 419.9), (159.9, 300.0), (480.0, 419.9)]
        keypoints.write("q01.jpg", np.array(corners, np.float32))
    (found,) = masked(folder)[0].facts
    assert found.endswith(" % masked, 4 keypoints of a kept, 2 of them on masked pixels")
    # those without a mask are not counted
    (workspace / "preprocessed/query/sensors/masks/q05.jpg.png").unlink()
    assert [one.name for one in masked(folder)] == ["q01.jpg", "q04.jpg", "q08.jpg"]


def test_the_panels_show_image_classes_and_what_is_left(workspace: Path) -> None:
    folder = folder_of(workspace)
    said, key_told, one, *_ = mask_blocks([folder])
    assert isinstance(one, Pictures)
    image, classes, left = (decoded(address_of(panel.element)) for panel in one.panels)
    assert image.shape == classes.shape == left.shape == (255, 340, 3)
    assert np.abs(image.astype(int) - 200).max() <= 3
    # each class has the colour that the key says; PNG keeps it exact
    assert isinstance(key_told, Paragraph) and isinstance(said, Paragraph)
    entry = r'background:(#[0-9a-f]{6})"></span>([a-z]+)<'
    key = {name: color for color, name in re.findall(entry, key_told.text)}
    assert set(key) == {"road", "building", "sky", "car"}
    pixels = {"sky": (10, 10), "building": (100, 10), "road": (250, 10), "car": (190, 170)}
    for name, pixel in pixels.items():
        assert "#{:02x}{:02x}{:02x}".format(*classes[pixel]) == key[name]
    assert next(iter(key)) == "car"  # what is masked stands first
    assert "its classes" in said.text and "Red to orange: classes that may move" in said.text
    # the car is shaded, nothing else
    scale = 340 / WIDTH
    rows, columns = (
        slice(round(s.start * scale) + 8, round(s.stop * scale) - 8) for s in CAR_PLACE
    )
    assert left[rows, columns, 1].max() < 130
    assert np.abs(left[:140].astype(int) - 200).max() <= 3
    # a dot for every keypoint, at its place
    keypoints = folder.keypoints("x").read(one.name) * scale
    found = re.findall(r"M([\d.]+) ([\d.]+)h0", one.panels[2].element)
    np.testing.assert_allclose(np.array(found, float), keypoints, atol=0.051)


def test_without_classes_the_mask_is_shown(workspace: Path) -> None:
    (workspace / "preprocessed/query/sensors/classes/classes.json").unlink()
    said, one, *_ = mask_blocks([folder_of(workspace)])
    assert isinstance(said, Paragraph) and "in the middle its mask, right" in said.text
    assert isinstance(one, Pictures)
    mask = decoded(address_of(one.panels[1].element))
    assert mask[190, 170].max() < 80 < 200 < mask[10, 10].min()


@pytest.mark.parametrize(
    ("spoilt", "content"),
    [
        ("sensors/masks/q01.jpg.png", b"?"),
        ("sensors/records_data/q01.jpg", b""),
        ("sensors/classes/q01.jpg.png", b"?"),
        ("sensors/classes/classes.json", b'{"classes": 3}'),
    ],
)
def test_what_is_broken_costs_no_report(workspace: Path, spoilt: str, content: bytes) -> None:
    (workspace / "preprocessed/query" / spoilt).write_bytes(content)
    shown = masked(folder_of(workspace))
    left_out = "masks" in spoilt or "records_data" in spoilt
    assert [one.name for one in shown] == ["q01.jpg", "q05.jpg", "q08.jpg"][left_out:]


def test_masks_beside_imported_images_are_found_where_none_are_prepared(
    workspace: Path,
) -> None:
    # keypoints and matches stand in the pixels of prepared images: all of the report sees those
    queries = context_of(workspace / "localized").queries
    assert queries is not None and queries.root == workspace / "preprocessed/query"
    (workspace / "preprocessed").rename(workspace / "elsewhere")
    context = context_of(workspace / "localized")
    assert context.masked == []
    assert context.queries is not None and context.queries.root == workspace / "query"
    write_image(workspace / "query/sensors/masks/q00.jpg.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    assert folder_of(workspace).root == workspace / "query"


def test_colors_tell_what_moves_and_no_two_are_equal() -> None:
    names = tuple(f"class {number}" for number in range(20))
    colors = class_colors(SegmentedClasses(classes=names, dynamic=frozenset(names[11:19])))
    assert len(np.unique(colors[:20], axis=0)) == 20
    red, green, blue = colors[:20].astype(int).T
    moving = np.arange(20) // 11 * (np.arange(20) < 19) == 1
    assert (red[moving] > np.maximum(green, blue)[moving]).all()
    assert (red[~moving] < np.maximum(green, blue)[~moving]).all()
    assert (colors[20:] == 0).all() and (class_colors(None) == 0).all()


def test_the_report_shows_them(
    workspace: Path, world: Any, page_of: Callable[[str], Any], kaptures: Callable[..., Path]
) -> None:
    evaluation = evaluate_poses(world.estimated, world.truth, conditions=world.conditions)
    html = render_report(replace(evaluation, context=context_of(workspace / "localized")))
    page = page_of(html)
    assert "What masks hide" in page.text
    assert "50 keypoints of x kept, 17 removed" in page.text
    # dots are nothing but round ends, and the figures' style is for every element of the page
    assert "stroke-linecap: butt" in html
    assert 'style="stroke-linecap:round"' in html
    assert len(html) < len(render_report(evaluation)) + 200_000
    without = ResultContext(masked=[KaptureFolder(kaptures(workspace / "plain", ["a.jpg"], {}))])
    for plain in (evaluation, replace(evaluation, context=without)):
        assert "What masks hide" not in page_of(render_report(plain)).text


def test_a_report_without_truth_shows_them_too(
    workspace: Path, page_of: Callable[[str], Any]
) -> None:
    rules = benchmark_of(workspace / "megloc")
    found = results_without_truth([workspace / "localized"], rules, labels=["mine"])
    assert "mine: what masks hide" in page_of(render_report(found)).text
    (result,) = found.results
    other = replace(found, results=(replace(result, context=ResultContext()),))
    assert "masks hide" not in page_of(render_report(other)).text

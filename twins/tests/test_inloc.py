"""The twin of InLoc: its layout, its import, and floors whose rooms are alike."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from megloc_twins.indoor_rooms import (
    ROOM_KINDS,
    Parts,
    Recipes,
    build_floor,
    build_module,
    build_room,
)
from megloc_twins.inloc import cam_from_scan, cutout_camera, phone_camera, scanned_points
from megloc_twins.rasterization import depth_map, sample_grid, visible_surfaces
from megloc_twins.surfaces import Surfaces

from megloc_kapture.io.images import read_depth_map, read_image_rgb

LAYOUT = "inloc"


def matrix_of(path: Path, first: int) -> np.ndarray:
    """Four rows of a transformation's file, from line ``first`` on."""
    lines = path.read_text().splitlines()[first : first + 4]
    return np.array([line.split() for line in lines], np.float64)


def test_files_as_published(root: Path) -> None:
    path = root / "database/cutouts/DUC1/001/DUC_cutout_001_60_0.jpg"
    content = scipy.io.loadmat(f"{path}.mat")
    assert content["XYZcut"].dtype == np.float64
    assert content["XYZcut"].shape == content["RGBcut"].shape == (48, 64, 3)
    assert content["RGBcut"].dtype == np.uint8
    off = np.abs(content["RGBcut"].astype(int) - read_image_rgb(path))
    assert off.mean() < 6  # as JPEG has it
    # the matrix before refinement is another
    for path in root.glob("database/alignments/*/transformations/*.txt"):
        before, after = (matrix_of(path, first) for first in (1, 7))
        assert 0.005 < np.linalg.norm(before[:3, 3] - after[:3, 3]) < 0.5


def test_scanned_points_are_seen_in_their_pixels(
    root: Path, imported: Callable[[str], Path]
) -> None:
    """From the file to the pixel by MATLAB's rules, scipy, numpy, kapture and COLMAP alone."""
    import kapture
    import pycolmap
    from kapture.io.csv import kapture_from_dir

    mapping = imported("inloc") / "mapping"
    theirs = kapture_from_dir(str(mapping))
    poses = kapture.rigs_remove(theirs.trajectories, theirs.rigs)
    depths = {t: name for t, _, name in kapture.flatten(theirs.records_depth)}
    columns, rows = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    missing = []
    for timestamp, sensor, name in list(kapture.flatten(theirs.records_camera))[::20]:
        points = scipy.io.loadmat(root / f"{name}.mat")["XYZcut"]
        _, _, floor, scan, _ = name.split("/")
        transformations = root / f"database/alignments/{floor}/transformations"
        matrix = matrix_of(transformations / f"DUC_trans_{scan}.txt", 7)
        seen = np.isfinite(points).all(axis=2)
        missing.append(1 - seen.mean())
        in_floor = points[seen] @ matrix[:3, :3].T + matrix[:3, 3]
        in_camera = poses[timestamp, sensor].transform_points(in_floor)
        model, width, height, *params = theirs.sensors[sensor].sensor_params
        size = {"width": int(width), "height": int(height)}
        camera = pycolmap.Camera(model=model, params=list(map(float, params)), **size)
        pixels = camera.img_from_cam(in_camera)
        np.testing.assert_allclose(pixels, np.column_stack([columns[seen], rows[seen]]), atol=1e-3)
        path = mapping / "sensors" / "records_data" / depths[timestamp]
        depth = read_depth_map(path, width=64, height=48)
        np.testing.assert_allclose(depth[seen], in_camera[:, 2], rtol=1e-6)
        assert (depth[~seen] == 0).all()
    assert 0.02 < np.mean(missing) < 0.3


def sizes_of(surfaces: Surfaces) -> np.ndarray:
    """Area of each, square metres."""
    return np.linalg.norm(np.cross(surfaces.edge_u, surfaces.edge_v), axis=1)


def areas(parts: Parts, recipes: Recipes) -> Counter[tuple[object, ...]]:
    """Area in square metres of each surface, by what and where it is."""
    surfaces, _ = parts.surfaces()
    result: Counter[tuple[object, ...]] = Counter()
    where = np.hstack([surfaces.origin, surfaces.edge_u, surfaces.edge_v, surfaces.uv]).round(6)
    for texture, shape, size in zip(surfaces.texture, where, sizes_of(surfaces), strict=True):
        result[recipes.items[texture], *shape] += float(size)
    return result


@pytest.mark.parametrize("kind", [*ROOM_KINDS, "corridor"])
def test_rooms_of_a_kind_differ_in_at_most_a_tenth_of_their_surface(kind: str) -> None:
    def built(owner: str) -> Counter[tuple[object, ...]]:
        recipes = Recipes(0)
        is_room = kind != "corridor"
        parts = build_room(recipes, kind, owner) if is_room else build_module(recipes, owner)
        return areas(parts, recipes)

    rooms = [built(f"floor{floor}/{kind}{number}") for floor in (0, 1) for number in (0, 1)]
    for room, other in permutations(rooms, 2):
        differs = sum((room - other).values()) / sum(room.values())
        assert 0.05 < differs <= 0.1
    assert built("floor0/x") == built("floor0/x")


def test_what_a_scanner_measures() -> None:
    floor, camera = build_floor(0, 0, 1), cutout_camera(80, 60)
    bright = np.full((60, 80, 3), 128, np.uint8)
    bright[:10] = 5
    missing = []
    for zone, (yaw, pitch) in product(floor.zones, ((0, 0), (120, -30), (240, 30))):
        cam_from_scanner = cam_from_scan(yaw, pitch)
        pose = cam_from_scanner @ zone.scan_from_place
        points = scanned_points(
            floor, camera, pose, cam_from_scanner, bright, np.random.default_rng(0)
        )
        seen = visible_surfaces(floor.place.surfaces, pose, sample_grid(camera, 1))
        known = np.isfinite(points).all(axis=2)
        assert not known[:10].any()  # too dark
        assert not known[floor.glass[np.maximum(seen.surface, 0)]].any()
        off = cam_from_scanner.apply(points[known])[:, 2] - depth_map(seen)[known]
        assert np.abs(off).max() < 0.006 and 1e-4 < np.std(off) < 2e-3
        np.testing.assert_array_equal(points[known], points[known].astype(np.float32))
        missing.append(1 - known[10:].mean())
        assert missing[-1] > 0.005  # dropouts
    assert 0.02 < np.mean(missing) < 0.3


def test_cutouts_turn_to_the_right_and_up() -> None:
    expected = {(0, 0): (-1, 0, 0), (90, 0): (0, 1, 0), (0, 30): (-np.sqrt(0.75), 0, 0.5)}
    for angles, direction in expected.items():
        ahead = cam_from_scan(*angles).rotation_matrix()[2]
        np.testing.assert_allclose(ahead, direction, atol=1e-8)  # of a settled pose
    assert phone_camera(4032, 3024).params[0] == 3136
    np.testing.assert_allclose(cutout_camera(1600, 1200).params[0], 1385.6406460551, rtol=1e-12)

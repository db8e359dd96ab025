"""Equal bytes on every processor, and the arithmetic for them compared with OpenCV's."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from megloc_twins.portable import averaged, blurred, product, resized, settled_pose
from megloc_twins.rasterization import bilinear

# what the libraries take from a processor can be withheld from them: these run as they do where
# there is no AVX and no fused multiplication, and without Intel's own filters
OLDER = {
    "OPENBLAS_CORETYPE": "Nehalem",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3,X86_V4,AVX512_ICL,AVX512_SPR,AVX2,FMA3,AVX512F,AVX512_SKX",
    "OPENCV_CPU_DISABLE": "AVX512-SKX,AVX2,AVX,FP16",
    "OPENCV_IPP": "disabled",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F",
    "NUMBA_CPU_NAME": "generic",
    "NUMBA_CPU_FEATURES": "",
}

FIELDS = """
import hashlib
import numpy as np
from megloc_twins.surfaces import build_atlas
from megloc_twins.frames import Frame, day_lighting, looking_at, night_lighting
from megloc_twins.synthetic_kapture import SENSOR_FROM_RIG
from megloc_twins.drawing import periodic_noise, smooth_noise
from megloc_twins.options import stream
from megloc_twins.rasterization import sample_colour, sample_grid, visible_surfaces
from megloc_twins.render import cast_shadows, cloud_texture, develop, radiance
from megloc_twins.surfaces import SurfaceBuilder
from megloc_twins.textures import TextureRecipe
from megloc_kapture.values import Camera

def digest(name, *arrays):
    parts = b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)
    print(name, hashlib.sha256(parts).hexdigest())

rng = stream(0, "portable")
poses = [looking_at(rng.normal(0, 3, 3), *rng.normal(0, 1, 3)) for _ in range(50)]
chain = poses[0]
for pose in poses[1:]:
    chain = chain @ pose.inverse() @ SENSOR_FROM_RIG["rig_left"]
    digest("pose", chain.quat_wxyz, chain.translation, chain.center())
digest("noise", smooth_noise(rng, 300, 400, cell=90), periodic_noise(rng, 256, cell=40))
wall = (("material", "brick"), ("material_seed", 3.0))
recipes = [TextureRecipe("wall", 300, 200, 1, wall)]
recipes += [TextureRecipe(p, 180, 160, 1) for p in ("window", "door", "shutter", "wood", "poster")]
textures = [recipe.paint() for recipe in recipes]
digest("textures", *textures)
builder = SurfaceBuilder()
for _ in range(60):
    at, size, yaw = rng.uniform(-8, 8, 2), rng.uniform(0.4, 2, 3), rng.uniform(0, 6)
    sides = tuple(rng.integers(0, len(textures), 4).tolist())
    builder.add_box(tuple(at), tuple(size), yaw, sides, 0)
surfaces = builder.build()
grid = sample_grid(Camera("SIMPLE_RADIAL", 320, 240, (230.0, 160.0, 120.0, -0.07)), 2)
lamps = rng.uniform((-5, -5, 2), (5, 5, 3), (6, 3))
day = day_lighting(rng, (1.0, 0.8), overcast=0.2)
night = night_lighting(rng, exposure=1.0)
atlas, clouds = build_atlas(textures), cloud_texture(0)
for look in (day, night):
    pose = looking_at(np.array([0.3, -7.0, 1.6]), 1.5, 0.05, 0.02)
    seen = visible_surfaces(surfaces, pose, grid)
    colour = sample_colour(seen, surfaces, atlas)
    shadows = cast_shadows(surfaces, look.sun_direction) if any(look.sun) else None
    light = radiance(
        seen, surfaces, colour, look, cam_from_place=pose, lamps=lamps, shadows=shadows,
        clouds=clouds,
    )
    digest(look.condition, seen.planes, seen.inverse_depth, colour, light)
    frame = Frame("f", "query", "", 0, 0, "s", grid.camera, pose, look, 1, bonnet=True)
    digest(look.condition + " developed", develop(light, frame, 2, 0))
"""

TWIN = """
import hashlib, sys
from pathlib import Path
from megloc_twins.{0} import {1}Twin, {1}TwinOptions
root = Path(sys.argv[1])
{1}Twin({1}TwinOptions({2})).write(root)
for path in sorted(p for p in root.rglob("*") if p.is_file()):
    print(path.relative_to(root), hashlib.sha256(path.read_bytes()).hexdigest())
"""
PROGRAMS = {
    "fields": FIELDS,
    "aachen": TWIN.format(
        "aachen",
        "Aachen",
        "num_places=1, stations_per_place=3, sequence_images=2, day_queries=1, night_queries=1,"
        " additional_night_queries=1, width=160, height=120, points_per_image=20",
    ),
    "4seasons": TWIN.format(
        "fourseasons",
        "FourSeasons",
        "num_places=1, map_keyframes=4, winter_keyframes=1, dusk_keyframes=1, width=200,"
        " height=100",
    ),
    "inloc": TWIN.format(
        "inloc",
        "InLoc",
        "modules=1, queries=2, cutout_width=64, cutout_height=48, query_width=96, query_height=72",
    ),
}


def printed(program: str, folder: Path, settings: dict[str, str]) -> list[str]:
    """Return the lines that a program prints in a new process with environment variables."""
    folder.mkdir()
    kept = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "compiled"), **settings}
    command = [sys.executable, "-c", program, str(folder / "twin")]
    done = subprocess.run(command, env=kept, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_an_older_processor_gives_the_same_bytes(name: str, tmp_path: Path) -> None:
    program = PROGRAMS[name]
    here = printed(program, tmp_path / "here", {})
    assert len(here) > 10
    assert printed(program, tmp_path / "older", OLDER) == here


@given(
    st.integers(2, 60), st.integers(2, 60), st.integers(0, 50), st.integers(0, 50), st.booleans()
)
def test_enlarging_is_opencvs(
    height: int, width: int, more_rows: int, more_columns: int, cubic: bool
) -> None:
    image = np.random.default_rng(0).random((height, width, 2), dtype=np.float32)
    size = (width + more_columns, height + more_rows)
    method = cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR
    expected = cv2.resize(image.astype(np.float64), size, interpolation=method)
    np.testing.assert_allclose(resized(image, *size, cubic=cubic), expected, atol=2e-5)


@pytest.mark.parametrize("deviation_px", [0.5, 0.8, 1.1, 3.0])
@pytest.mark.parametrize("shape", [(40, 50, 3), (8, 9)])
def test_blurring_is_opencvs(deviation_px: float, shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(1).random(shape, dtype=np.float32)
    size = 2 * round(4 * deviation_px) + 1
    expected = cv2.GaussianBlur(image, (size, size), deviation_px)
    np.testing.assert_allclose(blurred(image, deviation_px), expected, atol=1e-5)


@pytest.mark.parametrize("factor", [1, 2, 3, 8])
def test_averaging_leaves_out_what_fills_no_square(factor: int) -> None:
    image = np.random.default_rng(2).random((49, 66, 3), dtype=np.float32)
    height, width = 49 // factor, 66 // factor
    whole = image[: height * factor, : width * factor]
    expected = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(averaged(image, factor), expected, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_lookups_between_pixels_are_opencvs(dtype: type) -> None:
    rng = np.random.default_rng(3)
    image = (255 * rng.random((30, 40, 3))).astype(dtype)
    # OpenCV keeps 1/32 px of a position for uint8; beyond the edge too
    x, y = (rng.integers(-64, 32 * 44, (2, 20, 30)) / 32).astype(np.float32)
    method = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_REPLICATE}
    expected = cv2.remap(image.astype(np.float32), x, y, **method)
    np.testing.assert_allclose(bilinear(image, x, y), expected, atol=1e-3)


def test_lookups_nowhere_are_of_the_edge() -> None:
    image = np.arange(12, dtype=np.float32).reshape(3, 4, 1)
    x = np.array([[np.nan, np.inf, -np.inf, 1e30]], np.float32)
    np.testing.assert_array_equal(bilinear(image, x, x)[..., 0], [[0, 11, 0, 11]])


@given(st.integers(0, 2**32 - 1))
def test_products_and_poses_are_numpys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, matrix = rng.normal(size=(4, 5, 3)), rng.normal(size=(3, 3))
    np.testing.assert_allclose(product(points, matrix), points @ matrix, atol=1e-12)
    np.testing.assert_allclose(product(points, matrix[0]), points @ matrix[0], atol=1e-12)
    rotation = np.linalg.qr(matrix)[0]
    rotation *= np.sign(np.linalg.det(rotation))
    pose = settled_pose(rotation, matrix[0])
    np.testing.assert_allclose(pose.rotation_matrix(), rotation, atol=1e-8)
    np.testing.assert_allclose(pose.translation, matrix[0], atol=1e-9)


@pytest.mark.parametrize("last_bit", [-1e-16, 0.0, 1e-16])
@pytest.mark.parametrize("axis", range(3))
def test_half_a_turn_has_one_quaternion(axis: int, last_bit: float) -> None:
    rotation = -np.eye(3)
    rotation[axis, axis] = 1.0
    first, second = (index for index in range(3) if index != axis)
    rotation[first, second], rotation[second, first] = -last_bit, last_bit
    expected = [0.0] * 4
    expected[1 + axis] = 1.0
    pose = settled_pose(rotation, np.zeros(3))
    assert [value.hex() for value in pose.quat_wxyz] == [value.hex() for value in expected]

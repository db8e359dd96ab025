"""COLMAP's dense workspace: written, run where there is CUDA, read, and fused on any machine.

``images/NAME``, ``sparse/`` and ``stereo/{depth_maps,normal_maps}/NAME.KIND.bin``; a map is
``W&H&C&`` and float32 by channels. Images are pinholes without distortion.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap import MapImage, write_model
from megloc_kapture.io.colmap_cameras import load_pycolmap
from megloc_kapture.io.files import write_bytes
from megloc_kapture.io.images import write_image

MapKind = Literal["photometric", "geometric"]
_FOLDERS = {"depth": "depth_maps", "normal": "normal_maps"}


def has_cuda() -> bool:
    """Whether the installed pycolmap can run COLMAP's stereo."""
    return bool(load_pycolmap().has_cuda)


def write_workspace(
    root: Path,
    images: Sequence[MapImage],
    pixels: Sequence[NDArray[np.uint8]],
    observed: Sequence[tuple[NDArray[np.integer[Any]], NDArray[np.integer[Any]]]],
    xyz: NDArray[np.float64],
) -> None:
    """Write images and model of a workspace; ``root`` is an empty folder.

    Parameters
    ----------
    images : of PINHOLE cameras; keypoints, ``observed`` and ``xyz`` as of
        :func:`~megloc_kapture.io.colmap.write_model`: fusion finds an image's neighbours by them.
    pixels : uint8 (H, W, 3), RGB, of each.
    """
    for image, shown in zip(images, pixels, strict=True):
        path = root / "images" / image.name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, shown)
    write_model(root / "sparse", images, observed, xyz, np.zeros_like(xyz))
    for name in (*_FOLDERS.values(), "consistency_graphs"):
        (root / "stereo" / name).mkdir(parents=True)
    names = "".join(f"{image.name}\n" for image in images)
    write_bytes(root / "stereo" / "fusion.cfg", names.encode())


def run_patch_match(
    root: Path, name: str, sources: Sequence[str], depth_range_m: tuple[float, float]
) -> None:
    """Depth of one image of a workspace, compared with the sources; see :func:`has_cuda`."""
    pycolmap = load_pycolmap()
    text = f"{name}\n{', '.join(sources)}\n"
    write_bytes(root / "stereo" / "patch-match.cfg", text.encode())
    options = pycolmap.PatchMatchOptions()
    # one image by itself: what its neighbours say is looked at later, for all estimators alike
    options.geom_consistency = False
    options.depth_min, options.depth_max = depth_range_m
    pycolmap.patch_match_stereo(str(root), options=options)


def map_path(root: Path, kind: Literal["depth", "normal"], name: str, of: MapKind) -> Path:
    """Where a workspace has the depth or normals of an image."""
    return root / "stereo" / _FOLDERS[kind] / f"{name}.{of}.bin"


def write_map(path: Path, array: NDArray[np.floating]) -> None:
    """Write depth (H, W), 0 unknown, or normals (H, W, 3), camera frame, towards the camera."""
    values = np.asarray(array, "<f4")
    values = values[..., None] if values.ndim == 2 else values
    height, width, channels = values.shape
    head = f"{width}&{height}&{channels}&".encode()
    write_bytes(path, head + np.ascontiguousarray(values.transpose(2, 0, 1)).tobytes())


def read_map(path: Path) -> NDArray[np.float32]:
    """Read depth (H, W) or normals (H, W, 3); raises DataError."""
    try:
        content = path.read_bytes()
        *sizes, values = content.split(b"&", 3)
        width, height, channels = (int(size) for size in sizes)
        found = np.frombuffer(values, "<f4").astype(np.float32).reshape(channels, height, width)
    except (OSError, ValueError) as error:
        raise DataError(f"no map of COLMAP's stereo: {error}", path=path) from error
    return found[0] if channels == 1 else np.ascontiguousarray(found.transpose(1, 2, 0))


def fuse(root: Path, *, of: MapKind = "geometric", min_views: int = 2) -> NDArray[np.float64]:
    """Fuse the maps of a workspace by COLMAP; points float64 (N, 3) in the world.

    Raises DataError: its model has no points: COLMAP would then fuse nothing without a word.
    """
    pycolmap = load_pycolmap()
    if not pycolmap.Reconstruction(str(root / "sparse")).num_points3D():
        raise DataError("a model without points: no image has neighbours", path=root / "sparse")
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = min_views
    options.num_threads = 1
    fused = pycolmap.stereo_fusion(
        str(root / "fused.ply"), str(root), input_type=of, options=options, output_type="PLY"
    )
    points = [point.xyz for point in fused.points3D.values()]
    return np.array(points, np.float64).reshape(-1, 3)

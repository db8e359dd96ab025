"""COLMAP's sparse models, text or binary: the front of ``colmap_text`` and ``colmap_binary``.

Of a folder the cameras, images and points3D files are read; rigs and frames, which COLMAP writes
since version 4, say nothing that the images' poses do not.
"""

from __future__ import annotations

from pathlib import Path

from megloc_kapture.datasets.grammars import colmap_binary, colmap_text
from megloc_kapture.datasets.grammars.colmap_binary import read_colmap_binary, write_colmap_binary
from megloc_kapture.datasets.grammars.colmap_text import read_colmap_text, write_colmap_text
from megloc_kapture.datasets.grammars.colmap_values import ColmapImage, ColmapModel
from megloc_kapture.errors import DataError

__all__ = [
    "ColmapImage",
    "ColmapModel",
    "colmap_model_files",
    "read_colmap_model",
    "write_colmap_binary",
    "write_colmap_text",
]


def colmap_model_files(folder: Path, *, with_points: bool = True) -> tuple[Path, ...]:
    """The files of a folder that hold its model: the binary ones where there are any.

    Parameters
    ----------
    with_points : False leaves the points' file out.

    Raises
    ------
    DataError : the folder holds no model.
    """
    names = colmap_binary.FILES if _is_binary(folder) else colmap_text.FILES
    return tuple(Path(folder) / name for name in (names if with_points else names[:2]))


def read_colmap_model(folder: Path, *, with_points: bool = True) -> ColmapModel:
    """Read the model of a folder; the binary files count where there are both.

    Parameters
    ----------
    with_points : False reads cameras and poses only; the points' file need not exist.

    Raises
    ------
    DataError : no model, or a broken one; names the file and the line or byte.
    """
    read = read_colmap_binary if _is_binary(folder) else read_colmap_text
    return read(Path(folder), with_points=with_points)


def _is_binary(folder: Path) -> bool:
    if (Path(folder) / colmap_binary.IMAGES).is_file():
        return True
    if (Path(folder) / colmap_text.IMAGES).is_file():
        return False
    raise DataError(
        f"no COLMAP model: neither {colmap_binary.IMAGES} nor {colmap_text.IMAGES} is here",
        path=folder,
    )

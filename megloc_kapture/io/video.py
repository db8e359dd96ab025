"""Frames of video files as images."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from megloc_kapture.errors import DataError
from megloc_kapture.io.images import check_image_file, write_image

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".3gp"}
)


def extract_frames(video: Path, folder: Path, every: int) -> Iterator[str]:
    """Write every n-th frame of a video, the first included, as a JPEG file; yields their names.

    The names are the frames' numbers from 0: ``000120.jpg``. OpenCV turns frames as the file says.

    Raises
    ------
    DataError : missing, or OpenCV finds no frame in it.
    OutputError : a frame cannot be written.
    """
    import cv2

    check_image_file(video)
    capture = cv2.VideoCapture(str(video))
    try:
        number = 0
        while capture.grab():
            if number % every == 0:
                read, frame = capture.retrieve()
                if not read:
                    break
                name = f"{number:06}.jpg"
                write_image(folder / name, np.asarray(frame[:, :, ::-1], np.uint8))
                yield name
            number += 1
    finally:
        capture.release()
    if number == 0:
        raise DataError("no video, or without a frame that OpenCV can read", path=video)

"""Synthetic worlds on disk, drawn once per options and used again."""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
from collections.abc import Iterator
from concurrent.futures import Executor
from pathlib import Path

import cv2
import numpy as np

from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions
from megloc_kapture.datasets.synthetic.writing import write_synthetic_kapture
from megloc_kapture.io.atomic import output_error, replace_directory
from megloc_kapture.stages.parallel import Track, untracked

# raise when the same options draw other pixels or other files than before
SYNTHETIC_VERSION = 1


def fingerprint(options: SyntheticWorldOptions) -> str:
    """16 hexadecimal digits of the options and of all else that the bytes depend on."""
    content = {
        "options": options.model_dump(mode="json"),
        "version": SYNTHETIC_VERSION,
        "libraries": {"numpy": np.__version__, "opencv": cv2.__version__},
    }
    text = json.dumps(content, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def cached_synthetic_kapture(
    cache_root: Path,
    options: SyntheticWorldOptions | None = None,
    executor: Executor | None = None,
    *,
    track: Track = untracked,
) -> Path:
    """The folder of a synthetic world (see :func:`write_synthetic_kapture`), drawn if need be.

    A folder that is there is complete: it is drawn beside its place and renamed. Of several
    processes that want the same world, one draws and the others wait.

    Raises
    ------
    OutputError : the cache cannot be written.
    """
    options = options or SyntheticWorldOptions()
    name = f"synthetic-{fingerprint(options)}"
    place = Path(cache_root) / name
    if place.is_dir():
        return place
    with _locked(Path(cache_root) / f".{name}.lock"):
        if not place.is_dir():
            unfinished = Path(cache_root) / f".{name}.unfinished"
            shutil.rmtree(unfinished, ignore_errors=True)  # of a run that was killed
            write_synthetic_kapture(unfinished, options, executor, track=track)
            replace_directory(unfinished, place)
    return place


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock that the system releases when this process ends, however it ends."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(path, "w")  # noqa: SIM115 - closed below, the lock with it
    except OSError as error:
        raise output_error(path, error) from error
    with file:
        try:
            import fcntl
        except ImportError:  # not on Windows: two runs at once would draw twice
            yield
            return
        fcntl.flock(file, fcntl.LOCK_EX)
        yield

"""Run kapture-localization's tools on the packages this project uses.

kapture-localization 1.1.10 was written for numpy before 1.24 and pycolmap before 4, and it counts
on kapture 1.1.10 to bring ``np.float`` back. Its tools run unchanged once the two names they miss
exist again; this module puts them there for the time of one call::

    python benchmarks/speed/kloc_tools.py kapture_compute_matches -i MAP ...

Install it without its dependencies, of which two would break this environment:
``pip install --no-deps kapture-localization==1.1.10``.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import runpy
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from megloc_kapture.errors import OptionError

DISTRIBUTION = "kapture-localization"


def tool_scripts() -> dict[str, Path]:
    """The installed tools by name without ``.py``: ``{"kapture_compute_matches": path, ...}``.

    Raises
    ------
    OptionError : kapture-localization is not installed.
    """
    try:
        files = importlib.metadata.files(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        raise OptionError(
            f"{DISTRIBUTION} is not installed; "
            f"add it with: pip install --no-deps {DISTRIBUTION}==1.1.10"
        ) from None
    tools = (file for file in files if file.match("kapture_*.py"))
    return {file.stem: Path(str(file.locate())) for file in sorted(tools)}


@contextmanager
def shims(pycolmap: ModuleType) -> Iterator[None]:
    """While open, numpy and ``pycolmap`` have the names kapture-localization expects of them.

    Parameters
    ----------
    pycolmap : the imported pycolmap module (version 4). Names it has already are left alone.
    """
    added: list[tuple[ModuleType, str]] = []

    def add(module: ModuleType, name: str, value: Any) -> None:
        if not hasattr(module, name):
            setattr(module, name, value)
            added.append((module, name))

    def absolute_pose_estimation(
        points2d: Any, points3d: Any, camera: Any, estimation_options: Any = None
    ) -> dict[str, Any] | None:
        found: dict[str, Any] | None = pycolmap.estimate_and_refine_absolute_pose(
            np.asarray(points2d, dtype=np.float64).reshape(-1, 2),
            np.asarray(points3d, dtype=np.float64).reshape(-1, 3),
            camera,
            estimation_options or {},
        )
        if found is not None:
            # a list: the detailed report writes it as JSON
            found["inliers"] = [bool(inlier) for inlier in found["inlier_mask"]]
        return found

    try:
        add(np, "float", float)
        add(pycolmap, "absolute_pose_estimation", absolute_pose_estimation)
        yield
    finally:
        for module, name in added:
            delattr(module, name)


def run_tool(name: str, arguments: Sequence[str], pycolmap: ModuleType) -> None:
    """Run one tool in this process, as its script would run.

    Parameters
    ----------
    name : e.g. ``"kapture_compute_matches"``; a trailing ``.py`` is accepted.
    arguments : its command line, without the name.
    pycolmap : the imported pycolmap module.

    Raises
    ------
    OptionError : kapture-localization is not installed, or has no such tool.
    SystemExit : as the tool raises it, e.g. for wrong arguments.
    """
    scripts = tool_scripts()
    script = scripts.get(name.removesuffix(".py"))
    if script is None:
        raise OptionError(f"{DISTRIBUTION} has no tool {name!r}; it has: {', '.join(scripts)}")
    saved_argv, saved_path = sys.argv, sys.path
    # the tools import path_to_kapture_localization, which lies beside them
    sys.argv, sys.path = [str(script), *arguments], [str(script.parent), *sys.path]
    try:
        with shims(pycolmap):
            runpy.run_path(str(script), run_name="__main__")
    finally:
        sys.argv, sys.path = saved_argv, saved_path


def main() -> None:
    """``python benchmarks/speed/kloc_tools.py TOOL [ARGUMENT ...]``."""
    name, *arguments = sys.argv[1:] or [""]
    try:
        run_tool(name, arguments, importlib.import_module("pycolmap"))
    except OptionError as error:
        print(error, file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()

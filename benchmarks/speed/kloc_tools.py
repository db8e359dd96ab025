"""Run kapture-localization's tools with the packages of this project.

kapture-localization 1.1.10 was written for numpy before 1.24 and pycolmap before 4. Its tools run
unchanged if ``np.float`` and ``pycolmap.absolute_pose_estimation`` exist; this module adds them for
the duration of a call::

    python benchmarks/speed/kloc_tools.py kapture_compute_matches -i MAP ...

Install it without its dependencies, two of which would break this environment:
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
    """Return the installed tools by name: ``{"kapture_compute_matches": path, ...}``.

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
    """Add the names that kapture-localization expects to numpy and ``pycolmap`` (version 4).

    Existing names are not replaced; added names are removed on exit.
    """
    added: list[tuple[ModuleType, str]] = []

    def add(module: ModuleType, name: str, value: Any) -> None:
        if not hasattr(module, name):
            setattr(module, name, value)
            added.append((module, name))

    def absolute_pose_estimation(
        points2d: Any, points3d: Any, camera: Any, estimation_options: Any = None
    ) -> dict[str, Any] | None:
        result: dict[str, Any] | None = pycolmap.estimate_and_refine_absolute_pose(
            np.asarray(points2d, dtype=np.float64).reshape(-1, 2),
            np.asarray(points3d, dtype=np.float64).reshape(-1, 3),
            camera,
            estimation_options or {},
        )
        if result is not None:
            # a list, because the detailed report writes it as JSON
            result["inliers"] = [bool(inlier) for inlier in result["inlier_mask"]]
        return result

    try:
        add(np, "float", float)
        add(pycolmap, "absolute_pose_estimation", absolute_pose_estimation)
        yield
    finally:
        for module, name in added:
            delattr(module, name)


def run_tool(name: str, arguments: Sequence[str], pycolmap: ModuleType) -> None:
    """Run a tool in this process as a script.

    Parameters
    ----------
    name : e.g. ``"kapture_compute_matches"``, optionally with ``.py``.
    arguments : command line without the name.
    pycolmap : the imported module.

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
    # the tools import path_to_kapture_localization from their own folder
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

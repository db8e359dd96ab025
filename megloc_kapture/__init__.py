"""Visual localization in kapture: MegLoc's stages as kapture plugins.

>>> import megloc_kapture as megloc
>>> m = megloc.open_map("shared_map")                                       # doctest: +SKIP
>>> found = m.localize("query.jpg", megloc.Camera.pinhole(1920, 1080, 1371))  # doctest: +SKIP
>>> found.cam_from_world if found else found.reason                         # doctest: +SKIP
"""

import sys

# pycolmap 4.1.1 to 4.2.1 corrupt the heap when imported before zlib, so zlib is imported first; sys
# is always loaded already (tests/test_import_order.py)
import zlib  # noqa: F401
from importlib import import_module
from typing import TYPE_CHECKING, Any

from megloc_kapture.errors import DataError, MeglocError, OptionError, OutputError, PluginError

if sys.platform == "win32":
    raise ImportError(
        "megloc-kapture needs fcntl and fork servers, which Windows does not have; on Windows "
        "it runs under WSL 2"
    )

if TYPE_CHECKING:
    __version__: str
    from megloc_kapture.api import (
        Map,
        build_map,
        extract,
        map_photographs,
        match,
        open_map,
        run,
        solve_pose,
        train,
    )
    from megloc_kapture.evaluation.evaluate import evaluate
    from megloc_kapture.pipeline.export import export
    from megloc_kapture.pipeline.kapture_map import KaptureMap
    from megloc_kapture.pipeline.localizer import Localizer
    from megloc_kapture.pipeline.queries import Query
    from megloc_kapture.pipeline.results import Results
    from megloc_kapture.values import Camera, Failure, LocalFeatures, Pose, RigidTransform

__all__ = [
    "__version__",
    "Camera",
    "DataError",
    "Failure",
    "KaptureMap",
    "LocalFeatures",
    "Localizer",
    "Map",
    "MeglocError",
    "OptionError",
    "OutputError",
    "PluginError",
    "Pose",
    "Query",
    "Results",
    "RigidTransform",
    "build_map",
    "evaluate",
    "export",
    "extract",
    "map_photographs",
    "match",
    "open_map",
    "run",
    "solve_pose",
    "train",
]

# imported lazily, so that error classes do not load numpy, nor value types the solvers
_LAZY = {
    "values": ("Camera", "Failure", "LocalFeatures", "Pose", "RigidTransform"),
    "pipeline.kapture_map": ("KaptureMap",),
    "pipeline.localizer": ("Localizer",),
    "pipeline.queries": ("Query",),
    "pipeline.results": ("Results",),
    "pipeline.export": ("export",),
    "evaluation.evaluate": ("evaluate",),
    "api": tuple(name for name in __all__ if name != "__version__"),  # all remaining names
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("megloc-kapture")
    for module, names in _LAZY.items():
        if name in names:
            return getattr(import_module(f"megloc_kapture.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)

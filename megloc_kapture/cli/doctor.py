"""``megloc doctor``: versions, and combinations known to be bad."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

from megloc_kapture.cli.common import Common
from megloc_kapture.cli.weights import summary
from megloc_kapture.errors import MeglocError, missing_extra
from megloc_kapture.evaluation.provenance import installed_version

_PACKAGES = (
    "megloc-kapture",
    "kapture",
    "numpy",
    "scipy",
    "opencv-python-headless",
    "pycolmap",
    "poselib",
    "torch",
    "numba",
)


@dataclass(frozen=True, kw_only=True)
class Doctor(Common):
    """Check the environment: versions, known-bad combinations, GPU, weights."""

    def run(self) -> int:
        """Print what there is; exit status 2 when something is wrong."""
        console = self.console()
        for package in _PACKAGES:
            console.result(f"{package:24s}{installed_version(package) or 'not installed'}")
        console.result(f"{'GPU':24s}{gpu()}")
        console.result(f"{'weights':24s}{summary()}")
        problems = find_problems()
        for problem in problems:
            console.result(f"problem: {problem}")
        if problems:
            raise MeglocError(f"{len(problems)} problems found, see above")
        console.result("no problem found")
        return 0


def gpu() -> str:
    """Name of the GPU that torch sees."""
    try:
        import torch
    except ModuleNotFoundError as error:
        return f"unknown: {missing_extra(error) or error}"

    return torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none"


def find_problems() -> list[str]:
    """Known-bad combinations of installed packages, each with its remedy."""
    problems = []
    torch, vision = installed_version("torch"), installed_version("torchvision")
    if vision and torch and "+cpu" in torch:
        problems.append(
            f"torchvision {vision} beside torch {torch}: its CPU builds fail to import and break "
            "transformers too; pip uninstall torchvision"
        )
    if installed_version("opencv-python") and installed_version("opencv-python-headless"):
        problems.append(
            "opencv-python beside opencv-python-headless: both write the folder cv2; uninstall "
            "both and install opencv-python-headless"
        )
    if importlib.util.find_spec("cv2") is None:
        problems.append("cv2 cannot be imported; pip install opencv-python-headless")
    return problems

"""The datasets that ``megloc eval`` knows, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from megloc_kapture.datasets.kapture_folders import QUERY_GT, check_root
from megloc_kapture.datasets.synthetic.options import SYNTHETIC_VERSION, SyntheticWorldOptions
from megloc_kapture.errors import OptionError
from megloc_kapture.stages.parallel import Track

DATASETS = ("kapture", "synthetic")

Renderer = Callable[[Path], Mapping[str, float]]


@dataclass(frozen=True)
class DatasetChoice:
    """A dataset and where it comes from: a folder, or a rendered world."""

    name: str
    root: Path | None
    world: SyntheticWorldOptions | None = None

    def check(self) -> None:
        """Raise DataError when the folder cannot be the dataset's, before anything is written."""
        if self.root is not None:
            check_root(self.root)

    def has_truth(self) -> bool:
        """Whether the true poses of the queries are known."""
        if self.root is None:
            return True
        return (self.root / QUERY_GT / "sensors" / "sensors.txt").is_file()

    def renderer(self, executor: Executor | None, track: Track) -> Renderer | None:
        """Writes the world below the folder it is given; None for a dataset with a root."""
        if self.world is None:
            return None
        options = self.world

        def render(out: Path) -> Mapping[str, float]:
            from megloc_kapture.datasets.synthetic.writing import write_synthetic_kapture

            return write_synthetic_kapture(out / "world", options, executor=executor, track=track)

        return render

    def render_options(self) -> dict[str, Any]:
        """What determines the rendered world."""
        if self.world is None:
            return {}
        return {"version": SYNTHETIC_VERSION, "world": self.world.model_dump(mode="json")}


def choose_dataset(name: str, root: Path | None) -> DatasetChoice:
    """The dataset of a name.

    Raises
    ------
    OptionError : unknown name, or no root where one is needed.
    """
    if name == "kapture":
        if root is None:
            raise OptionError(
                "dataset kapture needs --root, a folder with mapping/, query/ and perhaps query_gt/"
            )
        return DatasetChoice(name, root)
    if name == "synthetic":
        return DatasetChoice(name, root, None if root else SyntheticWorldOptions())
    raise OptionError(f"unknown dataset {name!r}; known: {', '.join(DATASETS)}")

"""A small one of each rendered dataset, rendered once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from megloc_twins import render
from megloc_twins.aachen import AachenTwin, AachenTwinOptions
from megloc_twins.fourseasons import FourSeasonsTwin, FourSeasonsTwinOptions
from megloc_twins.inloc import InLocTwin, InLocTwinOptions
from megloc_twins.options import SyntheticDataset, SyntheticWorldOptions
from megloc_twins.robotcar import RobotCarTwin, RobotCarTwinOptions
from megloc_twins.surfaces import Atlas, build_atlas
from megloc_twins.synthetic_kapture import SyntheticKapture, SyntheticWorld, build_world
from megloc_twins.textures import TextureRecipe

from megloc_kapture.datasets.official import write_official
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import DATASETS

SIZE = {"width": 160, "height": 120, "supersampling": 1}
PLACES = {"num_places": 2, "day_queries": 2, "night_queries": 2}
CITY = {**PLACES, "day_queries": 4, "additional_night_queries": 2, "sequence_images": 3}
STREETS = {"num_locations": 2, "stops_per_location": 3, "moments_per_condition": 2}
DRIVES = {"num_places": 2, "map_keyframes": 6, "winter_keyframes": 3, "dusk_keyframes": 2}
CUTOUTS = {"cutout_width": 64, "cutout_height": 48, "query_width": 96, "query_height": 72}
SMALL: dict[str, SyntheticDataset[Any]] = {
    "synthetic": SyntheticKapture(
        SyntheticWorldOptions(**PLACES, **SIZE, stations_per_place=6, depth=True, masks=True)
    ),
    "aachen": AachenTwin(AachenTwinOptions(**CITY, **SIZE, stations_per_place=5)),
    "robotcar": RobotCarTwin(RobotCarTwinOptions(**STREETS, size_px=96, supersampling=1)),
    "4seasons": FourSeasonsTwin(
        FourSeasonsTwinOptions(**DRIVES, width=200, height=100, supersampling=1)
    ),
    "inloc": InLocTwin(InLocTwinOptions(**CUTOUTS, modules=1, queries=5, supersampling=1)),
}


def _plain_atlas(recipes: Iterable[TextureRecipe]) -> Atlas:
    """Random colours of 3 x 3 texels: layouts and poses do not depend on textures."""
    seeds = [recipe.seed for recipe in recipes]
    return build_atlas(
        [np.random.default_rng(seed).integers(60, 200, (3, 3, 3), np.uint8) for seed in seeds]
    )


@pytest.fixture(scope="session")
def plain_textures() -> Callable[[], AbstractContextManager[None]]:
    """Function: a context in which renderers paint small random textures."""

    @contextmanager
    def patched() -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(render, "painted", _plain_atlas)
            yield

    return patched


@pytest.fixture(scope="session")
def world() -> SyntheticWorld:
    """The world of the small synthetic dataset."""
    return build_world(SMALL["synthetic"].options)


@pytest.fixture(scope="session")
def small() -> dict[str, SyntheticDataset[Any]]:
    """What :func:`rendered` renders, by layout."""
    return SMALL


@pytest.fixture(scope="session")
def rendered(
    written_once: Callable[..., Path], plain_textures: Callable[[], AbstractContextManager[None]]
) -> Callable[[str], Path]:
    """Function: folder of the small dataset in a layout; not to be written into."""

    def folder(name: str) -> Path:
        with plain_textures():
            return written_once(f"rendered_{name}", SMALL[name].write)

    return folder


@pytest.fixture(scope="session")
def imported(
    written_once: Callable[..., Path], rendered: Callable[[str], Path]
) -> Callable[[str], Path]:
    """Function: import of the small dataset in a layout; not to be written into."""

    def folder(name: str) -> Path:
        dataset = load_plugin(DATASETS, name).read(rendered(name))
        return written_once(f"imported_{name}", partial(write_official, dataset))

    return folder


@pytest.fixture(scope="module")
def root(request: pytest.FixtureRequest, rendered: Callable[[str], Path]) -> Path:
    """Folder of the small dataset that a test file is about, its ``LAYOUT``."""
    return rendered(request.module.LAYOUT)

"""A photograph, and random weights of networks."""

from __future__ import annotations

from pathlib import Path

import pytest
from images import Image
from whole_preset_weights import Sizes, write_random_weights

from megloc_kapture.io.images import read_image_rgb


@pytest.fixture(scope="session")
def random_weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files of small networks by their names in the registry."""
    names = ("superpoint_v1", "aslfeat", "netvlad-pitts30k", "openibl")
    folder, sizes = tmp_path_factory.mktemp("weights"), Sizes(clusters=2, whitened=12)
    return write_random_weights(folder, sizes=sizes, names=names)


@pytest.fixture(scope="session")
def superpoint_weights(random_weights: dict[str, Path]) -> Path:
    return random_weights["superpoint_v1"]


@pytest.fixture(scope="session")
def photograph(shared_data: Path) -> Image:
    folder = shared_data / "scenes" / "fountain_p11" / "mapping" / "sensors" / "records_data"
    return read_image_rgb(folder / "0003.jpg")

"""Weights that processes of a machine share: one copy, the same values, and what was checked."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import torch

from megloc_kapture.features.global_networks import OpenIbl, OpenIblOptions
from megloc_kapture.io.weights import describe, read_weights, share_weights
from megloc_kapture.io.weights import shared as module
from megloc_kapture.nets.global_descriptors import VggNetVlad
from megloc_kapture.pipeline.executors import open_executor

CLUSTERS, OUTPUT = 64, 1024


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """OpenIBL's layout with random weights, 190 MB of them."""
    torch.manual_seed(0)
    net = VggNetVlad(order="kd", mean_rgb=(0, 0, 0), num_clusters=CLUSTERS, output_size=OUTPUT)
    path = tmp_path_factory.mktemp("weights") / "openibl.pth"
    torch.save(net.state_dict(), path)
    return path


def described(path: Path) -> tuple[np.ndarray, int, int]:
    """A vector; bytes of the process, pages of several divided among them, before and after."""
    before = _proportional_bytes()
    image = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    options = OpenIblOptions(weights=str(path), max_size_px=32, device="cpu")
    found = OpenIbl(options).describe(image)
    time.sleep(1.0)  # the other one has it as well
    return found, before, _proportional_bytes()


def _proportional_bytes() -> int:
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").is_file(), reason="Linux tells it")
def test_workers_have_one_copy(checkpoint: Path) -> None:
    alone, _, _ = described(checkpoint)
    with open_executor("processes", 2) as executor:
        assert executor is not None
        list(executor.map(_imported, range(8)))
        results = list(executor.map(described, [checkpoint] * 2))
    for found, _, _ in results:
        np.testing.assert_array_equal(found, alone)
    taken = sum(after - before for _, before, after in results)
    size = checkpoint.stat().st_size
    assert taken < 1.9 * size  # with two copies 2.5 times


def _imported(_: int) -> None:
    import megloc_kapture.features.global_networks  # noqa: F401

    torch.ones(64, 64) @ torch.ones(64, 64)
    time.sleep(0.1)


def test_what_was_read_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "own.pth"
    tensors = {"a": torch.rand(3, 4), "half": torch.rand(5).half(), "t": torch.rand(4, 2).T}
    torch.save(tensors, path)
    monkeypatch.setattr(module, "_folder", None)
    share_weights(tmp_path / "shared")
    try:
        file = describe("own", path)
        first = read_weights(file)  # the folder is not there: as without
        (tmp_path / "shared").mkdir()
        second, third = read_weights(file), read_weights(file)
        path.write_bytes(b"something else")
        fourth = read_weights(file)
    finally:
        share_weights(None)
    assert not getattr(first["a"], "is_shared_file", False)
    for found in (first, second, third, fourth):
        assert found.keys() == tensors.keys()
        for name, tensor in tensors.items():
            assert torch.equal(found[name], tensor) and found[name].dtype == tensor.dtype
    assert second["a"].is_shared_file  # type: ignore[attr-defined]

"""``megloc train``: its flags, its files, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from corner import pose_at, write_kapture
from safetensors.torch import load_file, save_file

from megloc_kapture.nets.xfeat import XFeatNetwork

SMALL = ("steps=2", "layers=2", "pairs_per_step=1", "max_keypoints=40", "pairs.max_size_px=200")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two kapture folders, and random weights."""
    root = tmp_path_factory.mktemp("inputs")
    for name, shift in (("mine", 0.0), ("other", 0.3)):
        poses = {f"{k}.png": pose_at((shift + 0.8 * k - 2, 0, 0), 12 - 12 * k, 0) for k in range(3)}
        write_kapture(root / name, poses, with_poses=True, with_depth=True)
    torch.manual_seed(0)
    save_file(XFeatNetwork().state_dict(), root / "xfeat.safetensors")
    return root


def arguments(inputs: Path, *more: str | Path) -> list[str | Path]:
    weights = f"features.options.weights={inputs / 'xfeat.safetensors'}"
    chosen = (*SMALL, weights, "features.options.threshold=0.0", "device=cpu")
    return [*(word for text in chosen for word in ("--set", text)), "--features", "xfeat", *more]


def test_a_matcher_and_its_files(megloc: Any, inputs: Path, tmp_path: Path) -> None:
    output = tmp_path / "small.safetensors"
    mine, other = inputs / "mine", inputs / "other"
    command = [
        "train",
        "matcher",
        "-i",
        mine,
        "--held-out",
        other,
        "--licence",
        f"{mine}=CC BY 4.0",
    ]
    done = megloc(*command, *arguments(inputs, "-o", output))
    assert done.status == 0, done.err
    assert "held out loss" in done.out and f"trained: {output}" in done.out
    assert "bin_score" in load_file(output)
    manifest = json.loads(output.with_suffix(".json").read_text())
    (data,) = manifest["training"]["data"]
    assert (data["folder"], data["licence"]) == ("mine", "CC BY 4.0")
    assert manifest["training"]["held_out_data"][0]["licence"] == "unknown"
    assert manifest["held_out"]["other"]["pairs"] == 100
    assert np.isfinite(manifest["held_out"]["other"]["loss"])
    again = megloc(*command, *arguments(inputs, "-o", output))
    assert again.status == 0 and again.out == done.out


def test_what_it_refuses(megloc: Any, inputs: Path, tmp_path: Path) -> None:
    output = ("-o", tmp_path / "x.safetensors")
    train = ("train", "descriptor", "-i", inputs / "mine", *output)
    for words, message in (
        (("--set", "step=3"), r"unknown option step; did you mean 'steps'"),
        (("--set", "pairs.labels.positive=3"), r"unknown option pairs\.labels\.positive"),
        (("--set", "layers=3"), r"option layers: Input should be a multiple of 2"),
        (("--set", "through=products", "--set", "layers=4"), r"layers changes nothing: through="),
        (("--licence", "MIT"), r"--licence takes FOLDER=TEXT, got 'MIT'"),
        (("--features", "rootsift"), r"superpoint and xfeat can be trained"),
        (("--features", "superpoint"), r"the weights superpoint_v1 are missing"),
    ):
        megloc(*train, *words).refused(message)
    megloc("train", "matcher", *output).refused("nothing to train on")
    megloc("train", "retriever", *output).refused("retriever")
    assert not list(tmp_path.iterdir())

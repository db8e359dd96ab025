"""Benchmark files: what they may say, and how one is found."""

from __future__ import annotations

from pathlib import Path

import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.dataset_tables import Protocol
from megloc_kapture.pipeline.datasets import TWIN_PREFIX, choose_dataset, dataset_names
from megloc_kapture.pipeline.presets import PRESETS, options_of_preset
from megloc_kapture.pipeline.run import BenchmarkFile, find_benchmark, read_benchmark

FILES = sorted(Path(__file__).parents[2].glob("benchmarks/*.toml"))


def test_a_benchmark_file(tmp_path: Path) -> None:
    path = tmp_path / "b.toml"
    path.write_text(
        'dataset = "kapture"\nthresholds = [[0.25, 2], [0.5, 5]]\n'
        "[options.query_pairs]\ntop_k = 9\n"
        "[options_with_query_depth.pose_refinement]\nby = ['icp']\n"
    )
    benchmark = read_benchmark(path)
    assert benchmark.thresholds == ((0.25, 2.0), (0.5, 5.0))
    for query_depth, refiners in ((False, []), (True, ["icp"])):
        changes = benchmark.changes(benchmark.preset, query_depth=query_depth)
        options = options_of_preset(benchmark.preset, changes=changes)
        assert options.query_pairs.top_k == 9
        assert [one.name for one in options.pose_refinement.by] == refiners


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_our_own_benchmark_files_are_good(path: Path) -> None:
    benchmark = read_benchmark(path)
    assert benchmark.dataset == path.stem
    for preset in PRESETS:
        options_of_preset(preset, changes=benchmark.changes(preset, query_depth=True))
    benchmark.change(Protocol())
    if benchmark.import_options:
        choose_dataset(benchmark.dataset, Path(), import_options=benchmark.import_options)


def test_every_dataset_has_a_benchmark_file() -> None:
    assert {path.stem for path in FILES} == {n for n in dataset_names() if TWIN_PREFIX not in n}


def test_a_twin_runs_as_its_dataset_does_but_has_no_published_figures() -> None:
    real, twin = (find_benchmark(name) for name in ("inloc", "synthetic-inloc"))
    assert real.published
    assert twin == real.model_copy(update={"dataset": "synthetic-inloc", "published": ()})
    assert find_benchmark("venice") == BenchmarkFile(dataset="venice")


def test_a_benchmark_changes_what_it_names_of_a_protocol() -> None:
    given = Protocol(dataset="x", conditions=("a",), pools={"p": ("a",)}, truth="nobody")
    changed = BenchmarkFile(dataset="x", conditions=("b", "a")).change(given)
    assert changed == given.model_copy(update={"conditions": ("b", "a")})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "b.toml: cannot be read: No such file"),
        (b"dataset = ", "b.toml: not TOML: "),
        (b"\xff\xfe", "b.toml: not TOML: "),
        (b"", "b.toml: dataset: "),
        (b'dataset = "x"\npreset_of = "y"\n', "b.toml: preset_of: "),
        (b'dataset = "x"\n[presets.best]\n', "b.toml: presets: .*unknown preset 'best'; known: "),
        (b'dataset = "x"\n[presets.megloc]\nset = 1\n', "b.toml: presets.megloc.set: "),
    ],
)
def test_a_broken_benchmark_file_is_named(
    tmp_path: Path, content: bytes | None, message: str
) -> None:
    if content is not None:
        (tmp_path / "b.toml").write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_benchmark(tmp_path / "b.toml")

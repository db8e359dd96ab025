"""Declarations of stages, and ordered, bounded work on executors."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from megloc_kapture.pipeline.evaluation_plan import PIPELINE
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.query_poses import LocalizeQueries
from megloc_kapture.stages.stage import PipelineStage, StageWork, wanted_stages
from megloc_kapture.stages.work import FolderSpec, ordered_map


class Declares(PipelineStage):
    name = "declares"
    uses = ("local_features.name", "mask_margin_px", "triangulation.two_view_tracks")

    def run(self, work: StageWork) -> Mapping[str, float]:
        return {}


def test_settings_are_the_declared_options() -> None:
    options = PipelineOptions(
        local_features=({"name": "rootsift", "options": {"max_keypoints": 5}}, {"name": "sift"})
    )
    assert Declares(options).settings() == {
        "local_features": [{"name": "rootsift"}, {"name": "sift"}],
        "mask_margin_px": 4.0,
        "triangulation": {"two_view_tracks": False},
    }


def test_a_new_matcher_changes_settings_of_matching_stages_only() -> None:
    changed = PipelineOptions(matching={"name": "nn", "options": {"max_ratio": 0.5}})
    same = [kind.name for kind in PIPELINE if isinstance(kind.name, str)]
    for kind in PIPELINE:
        before, after = kind(PipelineOptions()), kind(changed)
        if before.settings() != after.settings():
            same.remove(before.name)
    assert set(same) >= {"local_features", "global_features", LocalizeQueries.name, "map"}
    assert not {"mapping_matches", "query_matches"} & set(same)


def test_no_stage_reads_the_output_of_a_later_stage() -> None:
    for options in (PipelineOptions(), PipelineOptions(reranking={"by": "verified"})):
        written: list[str] = []
        stages = wanted_stages(PIPELINE, options)
        for at, stage in enumerate(stages):
            written += stage.writes
            later = {path for other in stages[at + 1 :] for path in other.writes}
            assert not set(stage.reads) & (later - set(written)), stage.name


def test_results_are_in_order() -> None:
    first_may_end = threading.Event()

    def work(value: int) -> int:
        if value == 0:
            assert first_may_end.wait(timeout=30)
        if value == 5:
            first_may_end.set()
        return value

    with ThreadPoolExecutor(3) as executor:
        assert list(ordered_map(work, range(20), executor, window=8)) == list(range(20))
        assert list(ordered_map(work, [], executor)) == []
    # without an executor results are computed lazily
    done: list[int] = []
    results = ordered_map(lambda value: done.append(value) or value, [3, 1, 2])
    assert done == []
    assert next(iter(results)) == 3
    assert done == [3]
    assert list(results) == [1, 2]


def test_at_most_a_window_of_items_is_submitted() -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        for value in range(100):
            taken += 1
            yield value

    with ThreadPoolExecutor(2) as executor:
        results = ordered_map(int, items(), executor, window=5)
        for count, _ in enumerate(results, start=1):
            assert taken <= count + 5


def test_a_folder_is_opened_once_in_a_run(world: Any) -> None:
    spec = FolderSpec(world.mapping())
    assert spec.open() is spec.open()
    # another run opens it again and reads new features
    other = FolderSpec(world.mapping())
    assert other.open() is not spec.open()

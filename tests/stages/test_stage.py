"""Declarations of stages: their settings, and the paths that they read and write."""

from __future__ import annotations

from collections.abc import Mapping

from megloc_kapture.pipeline.evaluation_plan import PIPELINE
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.query_poses import LocalizeQueries
from megloc_kapture.stages.stage import PipelineStage, StageWork, wanted_stages


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

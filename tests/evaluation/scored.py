"""Evaluation of poses in memory with conditions, statuses and confidences as mappings."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from megloc_kapture.evaluation import scoring
from megloc_kapture.evaluation.protocols import Benchmark
from megloc_kapture.evaluation.results import Result
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.io.dataset_tables import ImageGroup, Protocol
from megloc_kapture.values import RigidTransform


def evaluate_poses(
    estimated: Mapping[str, RigidTransform],
    truth: Mapping[str, RigidTransform],
    *,
    label: str = "",
    conditions: Mapping[str, str] | None = None,
    scored: Collection[str] | None = None,
    thresholds: Sequence[Any] | None = None,
    nowhere: Collection[str] = (),
    **options: Any,
) -> Evaluation:
    """``options`` are statuses, confidences and covariances by image."""
    groups = {
        image: ImageGroup(
            condition=(conditions or {}).get(image, ""), scored=scored is None or image in scored
        )
        for image in {*estimated, *truth, *nowhere}
    }
    result = Result(label, estimated, tuple(sorted(estimated)), **options)
    benchmark = Benchmark(protocol=Protocol(), groups=groups)
    return scoring.evaluate_poses(result, truth, benchmark, thresholds=thresholds, nowhere=nowhere)

"""Runs of one method as mean and spread."""

from __future__ import annotations

import numpy as np
import pytest

from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.comparison_text import format_spread, seeds_text
from megloc_kapture.evaluation.evaluate import Evaluation, evaluate
from megloc_kapture.evaluation.seeds import over_seeds
from megloc_kapture.evaluation.thresholds import Threshold
from megloc_kapture.values import RigidTransform

THRESHOLDS = [Threshold(position_m=0.25), Threshold(position_m=1.0)]


def run(label: str, errors_m: list[float]) -> Evaluation:
    names = [f"{i}.jpg" for i in range(len(errors_m))]
    estimated = {
        name: RigidTransform((1.0, 0.0, 0.0, 0.0), (error, 0.0, 0.0))
        for name, error in zip(names, errors_m, strict=True)
        if np.isfinite(error)
    }
    return evaluate(
        estimated,
        dict.fromkeys(names, RigidTransform.identity()),
        conditions={name: ("day", "night")[int(name[0]) % 2] for name in names},
        thresholds=THRESHOLDS,
        label=label,
    )


def test_mean_deviation_and_stability() -> None:
    runs = [
        run("seed 1", [0.1, 0.1, 0.1, 2.0]),
        run("seed 2", [0.1, 0.5, 0.1, np.inf]),
        run("seed 3", [0.1, 0.1, 0.5, 0.1]),
    ]
    seeds = over_seeds(runs)
    assert [row.name for row in seeds.rows] == ["day", "night", "all"]
    whole = seeds.rows[-1]
    recalls = [0.75, 0.5, 0.75]
    at = whole.recall[0]
    assert at.recall.mean == pytest.approx(np.mean(recalls))
    assert at.recall.deviation == pytest.approx(np.std(recalls, ddof=1))
    assert (at.recall.smallest, at.recall.largest) == (0.5, 0.75)
    assert (at.always, at.sometimes, at.never) == (1, 3, 0)
    assert (whole.recall[1].always, whole.recall[1].sometimes) == (3, 1)
    assert whole.num_localized.mean == pytest.approx(11 / 3)
    day = seeds.rows[0].recall[0]
    assert day.recall.mean == pytest.approx((1 + 1 + 0.5) / 3)


def test_a_run_without_median() -> None:
    seeds = over_seeds([run("1", [np.inf, np.inf]), run("2", [0.1, 0.2])])
    spread = seeds.rows[-1].median_position_m
    assert np.isinf(spread.mean) and spread.smallest == pytest.approx(0.15)
    assert format_spread(spread) == "inf"
    assert "inf" in seeds_text(seeds)


def test_as_text() -> None:
    text = seeds_text(over_seeds([run("a", [0.1, 0.1]), run("b", [0.1, 0.5])]))
    assert text.startswith("2 runs of one method: a, b\n")
    assert "75.0 +- 35.4 / 100.0 +- 0.0" in text
    assert "0.25 m  1 / 1 / 0\n" in text
    assert max(map(len, text.splitlines())) <= 100 and text.isascii()


def test_one_run_is_none() -> None:
    with pytest.raises(OptionError, match="at least two"):
        over_seeds([run("a", [0.1])])

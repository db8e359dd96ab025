"""The protocols of the benchmarks, by name."""

from __future__ import annotations

import pytest

from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.dataset_tables import Protocol


def test_thresholds_of_the_challenges() -> None:
    # papers: (0.25, 2) (0.5, 5) (5, 10) outdoors, (0.25, 0.5, 1 m; 10 deg) on InLoc, MLAD by metres
    outdoors = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
    assert protocol_of("aachen").thresholds == outdoors
    assert protocol_of("robotcar").thresholds == outdoors
    assert protocol_of("inloc").thresholds == ((0.25, 10.0), (0.5, 10.0), (1.0, 10.0))
    assert protocol_of("4seasons").thresholds == ((0.1, None), (0.2, None), (0.5, None))
    assert protocol_of("4seasons").pose_file == "mlad"
    assert protocol_of("kapture") == Protocol()
    robotcar = protocol_of("robotcar")
    pooled = [condition for parts in robotcar.pools.values() for condition in parts]
    assert sorted(pooled) == sorted(robotcar.conditions)
    assert robotcar.pools["night-all"] == ("night", "night-rain")
    assert len(robotcar.pools["day-all"]) == 7
    with pytest.raises(OptionError, match="known: aachen, robotcar, 4seasons, inloc"):
        protocol_of("synthetic-cmu")

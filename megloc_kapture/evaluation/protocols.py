"""Rules of the benchmarks: thresholds, conditions, names and frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from megloc_kapture.errors import OptionError
from megloc_kapture.io.dataset_tables import Protocol, SideTables, read_side_tables

TWIN_PREFIX = "synthetic-"

_KEPT_BY_LTVL = "The true poses of the queries are not published; visuallocalization.net keeps them"
_LTVL_THRESHOLDS = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
_DAY = ("dawn", "dusk", "overcast-summer", "overcast-winter", "rain", "snow", "sun")
_NIGHT = ("night", "night-rain")

PROTOCOLS = {
    protocol.dataset: protocol
    for protocol in (
        Protocol(
            dataset="aachen",
            pose_file_stem="Aachen_v1_1",
            thresholds=_LTVL_THRESHOLDS,
            pose_file_names="basename",
            truth=f"{_KEPT_BY_LTVL}.",
            conditions=("day", "night"),
        ),
        Protocol(
            dataset="robotcar",
            pose_file_stem="RobotCar",
            thresholds=_LTVL_THRESHOLDS,
            truth=(
                f"{_KEPT_BY_LTVL}. RobotCar Seasons v2 publishes the poses of its training images."
            ),
            conditions=(*_DAY, *_NIGHT),
            pools={"day-all": _DAY, "night-all": _NIGHT},
        ),
        Protocol(
            dataset="4seasons",
            pose_file_stem="4Seasons",
            thresholds=((0.1, None), (0.2, None), (0.5, None)),
            pose_file="mlad",
            truth=(
                "The true poses of the training and validation recordings are published "
                "(GNSSPoses.txt); those of the challenges' test recordings are kept by the MLAD "
                "challenges."
            ),
        ),
        Protocol(
            dataset="inloc",
            pose_file_stem="InLoc",
            thresholds=((0.25, 10.0), (0.5, 10.0), (1.0, 10.0)),
            pose_file_names="basename",
            truth=f"{_KEPT_BY_LTVL}.",
            conditions=("DUC1", "DUC2"),
        ),
        Protocol(dataset="kapture"),
        Protocol(dataset="synthetic"),
    )
}


def protocol_of(name: str) -> Protocol:
    """Return the protocol of a dataset; ``synthetic-X`` is scored like X, but has known truth."""
    if name in PROTOCOLS:
        return PROTOCOLS[name]
    layout = name.removeprefix(TWIN_PREFIX)
    if layout != name and layout in PROTOCOLS and PROTOCOLS[layout].truth:
        return PROTOCOLS[layout].model_copy(update={"dataset": name, "truth": ""})
    raise OptionError(f"unknown dataset {name!r}; known: {', '.join(PROTOCOLS)}")


def benchmark_of(side_tables: Path | str | None = None, dataset: str | None = None) -> SideTables:
    """Return the benchmark of a workspace's ``megloc/`` folder, of a dataset, or the default.

    A dataset overrides the protocol of the workspace, but not its groups, frame, names and pairs.
    """
    named = None if dataset is None else protocol_of(dataset)
    tables = SideTables() if side_tables is None else read_side_tables(Path(side_tables))
    return replace(tables, protocol=named or tables.protocol)

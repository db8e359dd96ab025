"""How each dataset is scored, by its name: the one place that says so.

Dataset adapters write these into the workspace's ``protocol.json``; ``megloc evaluate --dataset``
takes them where there is no workspace.
"""

from __future__ import annotations

from megloc_kapture.errors import OptionError
from megloc_kapture.io.side_tables import Protocol

TWIN_PREFIX = "synthetic-"

_KEPT_BY_LTVL = "The true poses of the queries are not published; visuallocalization.net keeps them"
_LTVL_THRESHOLDS = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
_DAY = ("dawn", "dusk", "overcast-summer", "overcast-winter", "rain", "snow", "sun")
_NIGHT = ("night", "night-rain")

_PROTOCOLS = {
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
            truth=f"{_KEPT_BY_LTVL}. RobotCar Seasons v2 publishes those of its training images.",
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


def protocol_names() -> list[str]:
    """The datasets :func:`protocol_of` knows, without the rendered twins."""
    return list(_PROTOCOLS)


def protocol_of(name: str) -> Protocol:
    """The protocol of a dataset; ``synthetic-X`` is scored as X is, and its truth is there.

    Raises
    ------
    OptionError : an unknown name; lists the known ones.
    """
    if name in _PROTOCOLS:
        return _PROTOCOLS[name]
    layout = name.removeprefix(TWIN_PREFIX)
    if layout != name and layout in _PROTOCOLS and _PROTOCOLS[layout].truth:
        return _PROTOCOLS[layout].model_copy(update={"dataset": name, "truth": ""})
    raise OptionError(f"unknown dataset {name!r}; known: {', '.join(_PROTOCOLS)}")

"""4Seasons' ``Transformations.txt``: how a recording's frames lie to one another.

Pairs of a line ``# name: ...`` and a line of numbers ``tx,ty,tz,qx,qy,qz,qw``, of the GNSS scale
one number. Blank lines between the pairs are there in some releases and not in others.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.datasets.grammars.fourseasons_lines import (
    parse_transform,
    split_fields,
    text_lines,
)
from megloc_kapture.datasets.grammars.fourseasons_poses import parse_scale
from megloc_kapture.errors import DataError
from megloc_kapture.values import RigidTransform

_S_AS, _W_GPSW, _E_GPSW = "transform_S_AS", "transform_w_gpsw", "transform_e_gpsw"
_SCALE = "GNSS scale"


@dataclass(frozen=True, slots=True)
class Transformations:
    """What leads from a recording's SLAM world to the earth.

    Parameters
    ----------
    s_from_as : the SLAM world, scaled to metres, made level; also called w, the visual world.
    w_from_gpsw : from the scene's east-north-up frame to the visual world.
    e_from_gpsw : from the scene's east-north-up frame to the earth (ECEF).
    gnss_scale : metres per unit of the SLAM world; None where the file does not say.
    """

    s_from_as: RigidTransform
    w_from_gpsw: RigidTransform
    e_from_gpsw: RigidTransform
    gnss_scale: float | None


def read_transformations(path: Path) -> Transformations:
    """Read ``Transformations.txt`` by the names in it; names that are not needed are passed over.

    Raises
    ------
    DataError : numbers without a name before them, a name given twice, one of the three transforms
        absent or broken; names file and line.
    """
    found: dict[str, tuple[int, list[str]]] = {}
    name: str | None = None
    number = 0
    for number, text in enumerate(text_lines(path), start=1):
        if text.startswith("#"):
            name = text[1:].partition(":")[0].strip(" \t")
        elif text:
            if name is None:
                raise DataError(
                    "numbers without a line '# name: ...' before them", path=path, line=number
                )
            if name in found:
                raise DataError(f"{name!r} is given twice", path=path, line=number)
            found[name] = (number, split_fields(text))
            name = None
    absent = [known for known in (_S_AS, _W_GPSW, _E_GPSW) if known not in found]
    if absent:
        raise DataError(f"there is no {', '.join(absent)}", path=path, line=number)
    s_from_as, w_from_gpsw, e_from_gpsw = (
        parse_transform(found[known][1], path, found[known][0])
        for known in (_S_AS, _W_GPSW, _E_GPSW)
    )
    scale = None
    if _SCALE in found:
        line, fields = found[_SCALE]
        if len(fields) != 1:
            raise DataError(f"expected one scale, got {len(fields)} numbers", path=path, line=line)
        scale = parse_scale(fields[0], path, line)
    return Transformations(s_from_as, w_from_gpsw, e_from_gpsw, scale)

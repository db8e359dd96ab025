"""Recall thresholds: a position bound and an angle bound that must both hold."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import Field

from megloc_kapture.errors import OptionError
from megloc_kapture.io.side_tables import Protocol
from megloc_kapture.values import Options


class Threshold(Options):
    """A query counts when both of its errors are at or below (``<=``).

    Parameters
    ----------
    position_m : bound on the distance of the camera centres, metres.
    angle_deg : bound on the rotation angle, degrees; None leaves the rotation out, as the MLAD
        challenges do.
    """

    position_m: float = Field(ge=0.0, allow_inf_nan=False)
    angle_deg: float | None = Field(default=None, ge=0.0, allow_inf_nan=False)

    @classmethod
    def parse(cls, text: str) -> Threshold:
        """From ``"0.25,2"`` (metres, degrees) or ``"0.25"`` (position only).

        Raises
        ------
        OptionError : the text is neither.
        """
        parts = text.replace(",", " ").split()
        try:
            numbers = [float(part) for part in parts]
            if len(numbers) not in (1, 2):
                raise ValueError
            return cls(position_m=numbers[0], angle_deg=numbers[1] if len(numbers) == 2 else None)
        except ValueError as error:  # pydantic's errors are ValueErrors too
            raise OptionError(
                f"threshold {text!r} is not METRES,DEGREES (both at or above 0), such as 0.25,2"
            ) from error

    def __str__(self) -> str:
        position = f"{self.position_m:g} m"
        return position if self.angle_deg is None else f"{position}, {self.angle_deg:g} deg"


def thresholds_from_pairs(pairs: Iterable[tuple[float, float | None]]) -> tuple[Threshold, ...]:
    """Thresholds of (metres, degrees or None) pairs, as a protocol keeps them."""
    return tuple(Threshold(position_m=p, angle_deg=a) for p, a in pairs)


DEFAULT_THRESHOLDS = thresholds_from_pairs(Protocol().thresholds)

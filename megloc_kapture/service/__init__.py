"""Localization over HTTP, ``megloc serve``; needs the extra ``serve``."""

from __future__ import annotations

from pydantic import Field

from megloc_kapture.values import Options


class Limits(Options):
    threads: int | None = Field(
        default=None,
        ge=1,
        description="Number of images localized in parallel; if omitted, all cores.",
    )
    max_waiting: int = Field(
        default=32, ge=1, description="Number of images that may wait; more are refused (503)."
    )
    max_mb: float = Field(default=20.0, gt=0, description="Largest request, megabytes.")
    max_megapixels: float = Field(default=32.0, gt=0, description="Largest image, megapixels.")

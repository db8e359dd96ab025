"""``megloc serve``: localization in a map over HTTP, with a page for photographs."""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from megloc_kapture.cli.common import (
    Common,
    Deciding,
    Force,
    Reading,
    check_consistent,
    existing,
    idle_for_types,
    opened_map,
    refuse_idle,
)
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.files import read_text
from megloc_kapture.pipeline.executors import available_cores
from megloc_kapture.pipeline.kapture_map import KaptureMap, PixelOriginChoice
from megloc_kapture.pipeline.local_types import local_types_of
from megloc_kapture.pipeline.localizer import LOCALIZING
from megloc_kapture.pipeline.presets import DEFAULT_PRESET, assigned, options_of_preset
from megloc_kapture.service.limits import Limits
from megloc_kapture.stages.matches import FeatureCache

if TYPE_CHECKING:
    from megloc_kapture.stages.options import PipelineOptions

_MIN_TOKEN_LENGTH = 16


@dataclass(frozen=True, kw_only=True)
class Serve(Reading, Deciding, Common):
    """Localize images that come by HTTP in a kapture map; with a page for photographs."""

    map: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")]
    """Kapture map: keypoints, points3d and observations; or a COLMAP model. Read only."""
    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0: every one of this machine."""
    port: int = 8000
    """Port to listen at; 0: a free one."""
    workers: int = 1
    """Processes that share the map's index; every limit is of each of them."""
    limits: Limits = Limits()
    token_file: Path | None = None
    """File with a token that clients have to send, 16 characters or more; none unless given."""
    proxy: str = ""
    """Address of a reverse proxy, whose X-Forwarded-For says who the client is."""
    keypoints_type: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Keypoints type to localize with; may be repeated; all that have points unless given."""
    pixel_origin: PixelOriginChoice = "auto"
    """Where the map's intrinsics put the pixel origin; auto finds it out."""
    force: Force = False
    """Localize in a map that contradicts itself."""

    def run(self) -> int:
        """Run it."""
        from megloc_kapture.cli.main import INTERRUPTED, TERMINATED, Terminated
        from megloc_kapture.service.server import ServedMap, bind, serve

        console = self.console()
        if self.workers < 1:
            raise OptionError(f"{self.workers} workers cannot work; give 1 or more")
        threads = self.limits.threads or max(1, available_cores() // self.workers)
        limits = self.limits.model_copy(update={"threads": threads})
        token = None if self.token_file is None else read_token(self.token_file)
        options = options_of_preset(
            self.preset or DEFAULT_PRESET, assignments=self.assignments(), used=LOCALIZING
        )
        with bind(self.host, self.port) as bound:
            served = ServedMap(
                opened_map(self.map, console),
                options,
                self.keypoints_type,
                existing(self.features_dir),
                self.pixel_origin,
                existing(self.allow_links_below),
            )
            kapture_map = served.open()
            check_consistent(kapture_map, self.map, force=self.force)
            check_acted_on(assigned(self.assignments()), kapture_map, options)

            def ready() -> None:
                host = f"[{self.host}]" if ":" in self.host else self.host
                where = f"http://{host}:{bound.getsockname()[1]}/"
                console.result(f"{len(kapture_map.images)} map images, served at {where}")
                if token is None and self.host not in ("127.0.0.1", "::1", "localhost"):
                    console.say("warning: without --token-file everybody may ask")

            try:
                serve(
                    served,
                    kapture_map,
                    bound,
                    limits=limits,
                    workers=self.workers,
                    proxy=self.proxy,
                    token=token,
                    log_requests=logging.getLogger().isEnabledFor(logging.INFO),
                    ready=ready,
                )
            except (KeyboardInterrupt, Terminated) as end:
                console.say("stopped")
                sys.exit(TERMINATED if isinstance(end, Terminated) else INTERRUPTED)
        return 0


def read_token(path: Path) -> str:
    """The token in a file: one line of printable ASCII; raises DataError."""
    token = read_text(path, max_bytes=10_000).strip()
    if len(token) < _MIN_TOKEN_LENGTH or not token.isascii() or not token.isprintable():
        raise DataError(
            f"a token is one line of {_MIN_TOKEN_LENGTH} or more printable characters", path=path
        )
    return token


def check_acted_on(
    typed: Mapping[str, Any], kapture_map: KaptureMap, options: PipelineOptions
) -> None:
    """Refuse options that were typed and change nothing for single images without depth.

    Raises
    ------
    OptionError : names the option, and why it changes nothing.
    """
    idle = idle_for_types(typed, local_types_of(kapture_map, options, FeatureCache()), options)
    localization = typed.get("localization", {})
    if localization.get("rigs") or localization.get("fallback") == "rig":
        idle["localization"] = "images come one by one, not on a rig"
    if any(one.name == "icp" for one in options.pose_refinement.by):
        idle["pose_refinement"] = "icp needs depth maps, and images come without"
    refuse_idle(typed, idle)

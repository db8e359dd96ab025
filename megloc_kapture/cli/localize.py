"""``megloc localize`` and ``megloc serve``: localization in a kapture map, which is only read."""

from __future__ import annotations

import logging
import signal
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from megloc_kapture.cli.common import (
    Common,
    Input,
    Localizing,
    Output,
    Overwrite,
    ReadingMap,
    cameras_of_text,
)
from megloc_kapture.errors import DataError, OptionError, check_option, require
from megloc_kapture.io.dataset_tables import METRES
from megloc_kapture.io.files import read_text
from megloc_kapture.io.kapture import KaptureFolder, read_pairs
from megloc_kapture.io.output_folders import staged_output
from megloc_kapture.io.tables import STATUS_FILE
from megloc_kapture.localization.focal_length import misfits_text
from megloc_kapture.pipeline.executors import available_cores
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.pipeline.query_folders import Photographs
from megloc_kapture.pipeline.results import Results
from megloc_kapture.stages.matches import candidates_of
from megloc_kapture.stages.paths import LOCALIZED

_log = logging.getLogger(__name__)

_MIN_TOKEN_LENGTH = 16
_LOOPBACK = ("127.0.0.1", "::1", "localhost")
_LIMITS = ("threads", "max_waiting", "max_mb", "max_megapixels")


@dataclass(frozen=True, kw_only=True)
class Localize(ReadingMap, Localizing, Common):
    """Localize photographs, or the images of a kapture folder, in a kapture map."""

    input: Input
    """Kapture map: keypoints, points3d and observations; or a COLMAP model. Read only."""
    query: Path | None = None
    """Kapture folder with the queries, and with their features if no extractor for the map's type
    of features is installed."""
    images: tuple[Path, ...] = ()
    """Instead of --query: photographs, videos, or folders of them. Focal lengths start from
    EXIF or a guess and are refined with the poses."""
    camera: str | None = None
    """MODEL,WIDTH,HEIGHT,PARAMETERS as in COLMAP for all --images, or a file with a row NAME MODEL
    WIDTH HEIGHT PARAMETERS per image; disables rotation by EXIF."""
    every: int | None = None
    """Use every N-th frame of the videos among --images; if omitted, 30."""
    output: Output = Path("localized")
    """Kapture folder with the queries' poses, and status.csv."""
    pairs: Path | None = None
    """Pairs file with the candidates of each query, instead of retrieval."""
    workers: int | None = None
    """Number of threads; if omitted, all cores."""
    force: Overwrite = False
    """Write into a non-empty folder, and localize in an inconsistent map."""

    def run(self) -> None:
        self._check_queries()
        workers = available_cores() if self.workers is None else self.workers
        folder: KaptureFolder | Photographs
        if self.query is None:
            folder = Photographs(self.images, cameras_of_text(self.camera), every=self.every)
            if not folder.names:
                name, reason = min(folder.unreadable.items())
                raise DataError(f"no photograph can be used; the first is {name}: {reason}")
        else:
            folder = self.kapture(self.query)
        kapture_map = _open_consistent_map(self, self.input)
        candidates = None if self.pairs is None else candidates_of(read_pairs(self.pairs))
        # invalid options and queries are rejected here, before anything is localized or written
        options = self.options()
        localizer = Localizer(kapture_map, options=options)
        results = Results(
            localizer, folder, workers=workers, candidates=candidates, track=self.track
        )
        queries = results.queries
        if candidates is not None:
            names, images = set(queries.names), set(kapture_map.images)
            require(
                any(name in names and not images.isdisjoint(c) for name, c in candidates.items()),
                "no row names both a query and a map image; a valid row would be: "
                f"{min(names)}, {min(images)}, 1.0",
                path=self.pairs,
            )
        inputs = (kapture_map.folder.root, self.input, self.query, *self.images)
        with staged_output(self.output, kind=LOCALIZED, force=self.force, inputs=inputs) as out:
            started = time.perf_counter()
            outcomes = list(results.items())
            seconds = time.perf_counter() - started
            counts = results.write_to(out)
        source = "from --pairs"
        if candidates is None:
            source = localizer.matching.describe_candidates(queries.shared_global_types())
        self.say(f"localized with {', '.join(local.name for local in localizer.types)}")
        self.say(f"candidates: {source}")
        self.say(f"pixel origin: {kapture_map.pixel_origin.intrinsics}")
        remarks = Counter(remark for _, result in outcomes for remark in result.remarks)
        focal = {remark for remark in remarks if "focal length" in remark}
        for remark in sorted(remarks.keys() - focal):
            self.say(f"skipped for {remarks[remark]} queries: {remark}")
        if not options.localization.rigs and len(queries.units(rigs=True)) < len(queries.names):
            self.say(
                "the cameras of a rig were localized separately; --set localization.rigs=true "
                "localizes them jointly"
            )
        if kapture_map.unit != METRES:
            self.say("positions are in units of the map, whose scale is unknown")
        if misfits := misfits_text(results.values(), STATUS_FILE):
            self.say(misfits)
        print(
            f"{counts['localized']} of {counts['queries']} queries localized in {seconds:.1f} s"
            + (f", {counts['fallbacks']} fallback poses" if counts["fallbacks"] else "")
            + f"; poses and status.csv in {self.output}"
        )
        if counts["queries"] and not counts["localized"]:
            self.say(f"warning: no query was localized; reasons are in {self.output}/status.csv")

    def _check_queries(self) -> None:
        if (self.query is None) == (not self.images):
            raise OptionError("give either --query (a kapture folder) or --images")
        check_option(
            self.query is None or (self.camera is None and self.every is None),
            "--camera and --every apply to --images only; a kapture folder has its own cameras",
        )
        check_option(
            self.query is None or not self.query.is_file(),
            f"--query {self.query}: not a kapture folder; give images with --images and a list of "
            "their cameras with --camera",
        )


@dataclass(frozen=True, kw_only=True)
class Serve(ReadingMap, Localizing, Common):
    """Serve localization in a kapture map over HTTP, with a web page to upload photographs."""

    map: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")]
    """Kapture map: keypoints, points3d and observations; or a COLMAP model. Read only."""
    host: str = "127.0.0.1"
    """Address to listen on; an address other than loopback needs --token-file."""
    port: int = 8000
    """Port to listen on; 0: any free port."""
    token_file: Path | None = None
    """File with the token that clients must send, at least 16 characters."""
    threads: int | None = None
    """Number of images localized in parallel; if omitted, all cores."""
    max_waiting: int = 32
    """Number of images that may wait; further images are rejected (503)."""
    max_mb: float = 20.0
    """Largest request in megabytes."""
    max_megapixels: float = 32.0
    """Largest image in megapixels."""
    force: Overwrite = False
    """Localize in an inconsistent map."""

    def run(self) -> None:
        from megloc_kapture.service.app import Service
        from megloc_kapture.service.server import bind, prepared_localizer, serve

        limits: dict[str, Any] = {name: getattr(self, name) for name in _LIMITS}
        for name, value in limits.items():
            flag = f"--{name.replace('_', '-')}"
            check_option(value is None or value > 0, f"{flag} {value}: must be positive")
        token = None if self.token_file is None else _read_token(self.token_file)
        if token is None and self.host not in _LOOPBACK:
            raise OptionError(
                f"--host {self.host}: reachable from other machines; give --token-file"
            )
        options = self.options()  # rejects invalid options before the map is read
        with bind(self.host, self.port) as bound:
            kapture_map = _open_consistent_map(self, self.map)
            localizer = prepared_localizer(kapture_map, options)
            host = f"[{self.host}]" if ":" in self.host else self.host
            where = f"http://{host}:{bound.getsockname()[1]}/"
            print(f"{len(kapture_map.images)} map images, listening at {where}")
            log_requests = logging.getLogger().isEnabledFor(logging.INFO)
            service = Service(localizer, **limits, token=token)
            try:
                serve(service, bound, log_requests=log_requests)
            except KeyboardInterrupt:
                self.say("stopped")
                sys.exit(128 + signal.SIGINT)


def _read_token(path: Path) -> str:
    """Read a one-line token of printable ASCII."""
    token = read_text(path).strip()
    require(
        len(token) >= _MIN_TOKEN_LENGTH and token.isascii() and token.isprintable(),
        f"the token must be one line of {_MIN_TOKEN_LENGTH} or more printable ASCII characters",
        path=path,
    )
    return token


def _open_consistent_map(command: Localize | Serve, path: Path) -> KaptureMap:
    """Open a map or COLMAP model; raise DataError if it is inconsistent, or warn if forced."""
    kapture_map = command.open_map(command.opened_map(path, force=command.force))
    if fault := kapture_map.fault():
        message = f"{fault}; the poses would be wrong (--force localizes anyway)"
        require(command.force, message, path=path)
        _log.warning("%s: %s; the poses may be wrong", path, fault)
    return kapture_map

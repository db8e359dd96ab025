"""Lazily computed results of a kapture folder or of photographs."""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

from megloc_kapture.errors import DataError, check_option
from megloc_kapture.evaluation.pose_files import COLUMNS
from megloc_kapture.io.csv_table import write_records
from megloc_kapture.io.dataset_tables import write_unit
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.output_folders import staged_output
from megloc_kapture.io.tables import CONSISTENCY_FILE, ConsistencyRow, status_row
from megloc_kapture.localization.focal_length import solve_with_shared_camera
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.pipeline.queries import Query
from megloc_kapture.pipeline.query_folders import KaptureQueries, Photographs, Queries
from megloc_kapture.stages.localized_folder import unreadable_image, write_localized
from megloc_kapture.stages.paths import LOCALIZED
from megloc_kapture.stages.scene import Unit
from megloc_kapture.stages.work import Track, untracked
from megloc_kapture.values import Failure, Pose, RigidTransform

if TYPE_CHECKING:
    import pandas as pd

Candidates = Mapping[str, Sequence[str]]
_POSE = COLUMNS.split()[1:]


class Results(Mapping[str, Pose | Failure]):
    """Mapping from image name to result, sorted by name, except that rig images may be adjacent.

    Access to an image localizes it and all images before it. Photographs share cameras, so the
    first access localizes all of them. Results are cached; an unusable image gives a Failure.
    ``candidates`` are map images by query name, which replace retrieval.
    """

    def __init__(
        self,
        localizer: Localizer,
        folder: KaptureFolder | Path | str | Photographs,
        *,
        workers: int = 1,
        candidates: Candidates | None = None,
        track: Track = untracked,
    ) -> None:
        check_option(workers >= 1, f"{workers} workers: give 1 or more")
        self.localizer = localizer
        self.queries: Queries
        if isinstance(folder, Photographs):
            self.queries = folder
        else:
            opened = folder if isinstance(folder, KaptureFolder) else KaptureFolder(folder)
            self.queries = KaptureQueries(opened, localizer.map)
        localizer.map.check()
        self.queries.check()
        for local in localizer.types:
            if (lacking := self.queries.first_without_features(local.name)) is not None:
                local.required_extractor(f"image {lacking!r}")
        self._candidates = candidates
        self._units = self.queries.units(rigs=localizer.options.localization.rigs)
        self._found: dict[str, Pose | Failure | None] = {
            name: None for unit in self._units for name, _ in unit
        }
        if broken := self.queries.unreadable:
            self._found |= {name: unreadable_image(name, reason) for name, reason in broken.items()}
            self._found = dict(sorted(self._found.items()))
        self._start = partial(self._localized, workers, track)
        self._stream = self._start()
        self._lock = Lock()  # for threads that share the results

    def __getitem__(self, name: str) -> Pose | Failure:
        with self._lock:
            while (outcome := self._found[name]) is None:
                try:
                    other, result = next(self._stream)
                except BaseException:
                    self._stream = self._start()  # for the next access: this one is exhausted
                    raise
                self._found[other] = result
        return outcome

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)

    def __reduce__(self) -> tuple[type[dict[str, Pose | Failure]], tuple[Any, ...]]:
        """Pickle as a plain dict."""
        return dict, (list(self.items()),)

    def save(self, output: Path | str, *, force: bool = False) -> dict[str, int]:
        """Write a kapture folder with ``status.csv`` and, if enabled, fallbacks; return counts."""
        inputs = (self.localizer.map.folder.root,)
        with staged_output(Path(output), kind=LOCALIZED, force=force, inputs=inputs) as out:
            return self.write_to(out)

    def write_to(self, output: Path) -> dict[str, int]:
        fallback = self.localizer.options.localization.fallback
        best = self._best_candidates() if fallback == "retrieval" else {}
        counts = write_localized(
            output, self.queries.data(), self.values(), fallback=fallback, first_candidates=best
        )
        self.queries.write_images(output)
        write_unit(output, self.localizer.map.unit)
        if tested := self.localizer.refiners.tested():
            write_records(output / CONSISTENCY_FILE, ConsistencyRow, tested)
        return counts

    def to_pandas(self) -> pd.DataFrame:
        """Return one row per image: columns of ``status.csv``, and pose columns (NaN if failed)."""
        import pandas as pd

        rows = []
        for name, result in self.items():
            row = {**status_row(result), "image": name, "candidates": list(result.candidates)}
            numbers: tuple[float, ...] = (float("nan"),) * len(_POSE)
            if isinstance(result, Pose):
                numbers = (*result.cam_from_world.quat_wxyz, *result.cam_from_world.translation)
            rows.append({**row, **dict(zip(_POSE, numbers, strict=True))})
        return pd.DataFrame(rows).set_index("image")

    def view(self, path: Path | str, truth: Path | str | None = None) -> None:
        """Write a 3D page; see :func:`megloc_kapture.evaluation.view.write_view`."""
        from megloc_kapture.evaluation.view import write_view

        data, cameras = self.queries.data(), {}
        for name in self:
            with contextlib.suppress(DataError):  # photographs may lack a known camera
                cameras[name] = data.camera_of(name)
        folder = self.localizer.map.folder
        write_view(path, folder, self, truth, cameras=cameras)

    def _query(self, name: str) -> Query:
        query = self.queries.query(name)
        if self._candidates is None or name in self.queries.faults:
            return query
        return replace(query, candidates=self._candidates.get(name, ()))

    def _localized(self, workers: int, track: Track) -> Iterator[tuple[str, Pose | Failure]]:
        executor = ThreadPoolExecutor(workers)
        missing = [
            unit for unit in self._units if any(self._found[name] is None for name, _ in unit)
        ]
        try:
            units = (tuple((self._query(name), at) for name, at in unit) for unit in missing)
            results = self.localizer.localize_units(units, executor)
            tracked = track(results, len(missing), "localizing")
            if isinstance(self.queries, Photographs):
                alone = [outcome for (outcome,) in tracked]
                tracked = ([outcome] for outcome in self._with_shared_cameras(missing, alone))
            for unit, outcomes in zip(missing, tracked, strict=True):
                for (name, _), result in zip(unit, outcomes, strict=True):
                    if isinstance(result, Failure) and name in self.queries.faults:
                        result = replace(result, reason=self.queries.faults[name])
                    yield name, result
        finally:
            # do not wait: the garbage collector may close this generator in any thread, even in one
            # that holds locks needed to stop the workers
            executor.shutdown(wait=False)

    def _with_shared_cameras(
        self, units: Sequence[Unit], results: list[Pose | Failure]
    ) -> list[Pose | Failure]:
        data, of_sensor = self.queries.data(), defaultdict(list)
        for at, (((name, _),), result) in enumerate(zip(units, results, strict=True)):
            if isinstance(result, Pose):
                of_sensor[data.record_of(name)[1]].append((at, result))
        for members in of_sensor.values():
            poses = [pose for _, pose in members]
            solved = solve_with_shared_camera(poses, self.localizer.options.localization.pose)
            for (at, _), pose in zip(members, solved, strict=True):
                results[at] = pose
        return results

    def _best_candidates(self) -> dict[str, tuple[str, RigidTransform]]:
        poses = self.localizer.map.poses
        best = {}
        for name, result in self.items():
            if result or name in self.queries.faults or name in self.queries.unreadable:
                continue
            # undecodable images fail here as in localization
            with contextlib.suppress(DataError):
                for first in self.localizer.ranked(self._query(name))[:1]:
                    best[name] = (first, poses[first])
        return best

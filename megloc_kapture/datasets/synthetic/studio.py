"""Drawing many shots, on any executor: what every writer of a rendered dataset shares."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Generic, TypeVar

from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions
from megloc_kapture.datasets.synthetic.places import Place, build_place
from megloc_kapture.datasets.synthetic.shots import Shot
from megloc_kapture.datasets.synthetic.views import PlacePainter, View
from megloc_kapture.stages.work import Track, ordered_map, untracked

Result = TypeVar("Result")
PlaceBuilder = Callable[[SyntheticWorldOptions, int], Place]

_SHOTS_PER_JOB = 13  # painting a place's textures costs about as much as four images


@dataclass(frozen=True)
class _Job(Generic[Result]):
    options: SyntheticWorldOptions
    build: PlaceBuilder
    shots: tuple[Shot, ...]  # all of one place
    with_depth: frozenset[str]
    finish: Callable[[Shot, View], Result]


def draw_shots(
    options: SyntheticWorldOptions,
    shots: Sequence[Shot],
    finish: Callable[[Shot, View], Result],
    *,
    with_depth: Iterable[str] = (),
    build: PlaceBuilder = build_place,
    executor: Executor | None = None,
    track: Track = untracked,
) -> dict[str, Result]:
    """Draw every shot and hand it to ``finish`` where it was drawn; its results by image name.

    Parameters
    ----------
    finish : called as ``finish(shot, view)``, in another process where there is an executor: a
        function of a module, or a ``functools.partial`` of one. It writes the files and returns
        what little the caller needs.
    with_depth : names of the shots that need ``view.depth_m``.
    build : lays out a place of these options by its index, the same in every process.
    """
    wanted = frozenset(with_depth)
    jobs = list(_jobs(options, shots, finish, wanted, build))
    drawn = (pair for pairs in ordered_map(_draw, jobs, executor) for pair in pairs)
    return dict(sorted(track(drawn, len(shots), "drawing"), key=lambda pair: pair[0]))


def _jobs(
    options: SyntheticWorldOptions,
    shots: Sequence[Shot],
    finish: Callable[[Shot, View], Result],
    with_depth: frozenset[str],
    build: PlaceBuilder,
) -> Iterator[_Job[Result]]:
    for place in sorted({shot.place for shot in shots}):
        here = [shot for shot in shots if shot.place == place]
        for start in range(0, len(here), _SHOTS_PER_JOB):
            some = tuple(here[start : start + _SHOTS_PER_JOB])
            depths = with_depth & {shot.name for shot in some}
            yield _Job(options, build, some, depths, finish)


@lru_cache(maxsize=1)
def _painter(options: SyntheticWorldOptions, build: PlaceBuilder, place: int) -> PlacePainter:
    return PlacePainter(
        build(options, place), seed=options.seed, supersampling=options.supersampling
    )


def _draw(job: _Job[Any]) -> list[tuple[str, Any]]:
    results = []
    for shot in job.shots:
        painter = _painter(job.options, job.build, shot.place)
        view = painter.draw(shot, depth=shot.name in job.with_depth)
        results.append((shot.name, job.finish(shot, view)))
    return results

"""Work on a dask cluster: the same bytes as here, whatever happens to its workers."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client
from threadpoolctl import threadpool_info

import megloc_kapture as megloc
from megloc_kapture.errors import DataError, MeglocError, OptionError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline import dask_executor
from megloc_kapture.pipeline.executors import open_executor
from megloc_kapture.pipeline.query_folders import KaptureQueries
from megloc_kapture.stages.work import ordered_map
from megloc_kapture.values import Pose

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from kills import (  # noqa: E402
    At,
    Cluster,
    Given,
    contents,
    kill_session,
    resume_after_kills,
    run_with_kills,
    running,
)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A cluster for those who leave it as it is."""
    with running(tmp_path_factory.mktemp("cluster")) as found:
        yield found


def _slow_square(number: int) -> tuple[int, int]:
    time.sleep(0.02)
    return number * number, os.getpid()


def _threads(_: int) -> set[int]:
    (np.ones((64, 64)) @ np.ones((64, 64))).sum()
    return {pool["num_threads"] for pool in threadpool_info()}


def _broken(path: Path) -> None:
    raise DataError("expected so, got thus", path=path, line=3)


def _read(path: Path) -> str:
    return path.read_text()


def _die_once(place: Path) -> str:
    if not place.exists():
        place.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "done"


def test_results_come_in_order_from_workers_with_one_thread(cluster: Cluster) -> None:
    with open_executor("dask", scheduler=cluster.address) as executor:
        found = list(ordered_map(_slow_square, range(40), executor))
        assert [square for square, _ in found] == [n * n for n in range(40)]
        assert len({pid for _, pid in found} - {os.getpid()}) == 2
        assert set().union(*ordered_map(_threads, range(8), executor)) == {1}


def test_relative_paths_start_where_the_run_started(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("here.txt").write_text("seen")
    with open_executor("dask", scheduler=cluster.address, shared=Path("out")) as executor:
        assert list(ordered_map(_read, [Path("here.txt")] * 3, executor)) == ["seen"] * 3
    assert list(Path("out").iterdir()) == []


def test_what_an_item_raises_arrives_as_it_is(cluster: Cluster) -> None:
    with (
        pytest.raises(DataError, match=r"^a/b.txt:3: expected so, got thus$") as error,
        open_executor("dask", scheduler=cluster.address) as executor,
    ):
        list(ordered_map(_broken, [Path("a/b.txt")], executor))
    assert error.value.path == Path("a/b.txt")


def test_what_fails_in_closing_hides_no_error(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    close = Client.close

    def failing(client: Client) -> None:
        was_open = client.status != "closed"
        close(client)
        if was_open:
            raise RuntimeError("Cannot change state of expiring Timeout")  # as dask's own, at times

    monkeypatch.setattr(Client, "close", failing)
    with (
        pytest.raises(DataError, match="expected so, got thus"),
        open_executor("dask", scheduler=cluster.address) as executor,
    ):
        list(ordered_map(_broken, [Path("a/b.txt")], executor))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"packages": {"numpy": "0.1"}}, r"worker tcp://\S+ has numpy \S+, this process 0\.1$"),
        ({"weights": {"superpoint_v1": "0" * 64}}, "has no weights of superpoint_v1"),
        ({"folder": Path("/nowhere/at/all")}, "does not see /nowhere/at/all"),
        ({"token": Path("/nowhere/.token")}, "does not see /nowhere/.token"),
    ],
)
def test_a_worker_that_differs_is_refused_before_it_works(
    cluster: Cluster,
    change: dict[str, Any],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    made = dask_executor._Preparation.of_this_process

    def differing(shared: Path, *, elsewhere: bool) -> Any:
        own = made(shared, elsewhere=elsewhere)
        changed = {**own.packages, **change["packages"]} if "packages" in change else None
        return replace(own, **({"packages": changed} if changed else change))

    monkeypatch.setattr(dask_executor._Preparation, "of_this_process", differing)
    with (
        pytest.raises(MeglocError, match=words),
        open_executor("dask", scheduler=cluster.address, shared=tmp_path),
    ):
        pytest.fail("it was not refused")


def test_a_worker_that_was_killed_costs_no_result(tmp_path: Path) -> None:
    with open_executor("dask", 2) as executor:
        places = [tmp_path / str(number) for number in range(3)]
        assert list(ordered_map(_die_once, places, executor)) == ["done"] * 3


@pytest.mark.slow  # distributed tries for ten seconds to reach it again
def test_a_scheduler_that_goes_away_is_one_line(tmp_path: Path) -> None:
    with (
        running(tmp_path, 1) as found,
        pytest.raises(MeglocError, match=f"scheduler {found.address} has gone; .*to go on$"),
        open_executor("dask", scheduler=found.address) as executor,
    ):
        for number, _ in enumerate(ordered_map(_slow_square, range(500), executor)):
            if number == 3:
                kill_session(found.scheduler.pid)


def test_what_cannot_be_used_is_refused(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_executor, "_CONNECT_S", 1.0)
    with (
        pytest.raises(OptionError, match="no dask scheduler at tcp://127.0.0.1:1$"),
        open_executor("dask", scheduler="tcp://127.0.0.1:1"),
    ):
        pass
    with pytest.raises(OptionError, match="--workers"):
        open_executor("dask", 2, cluster.address).__enter__()
    with pytest.raises(OptionError, match="--scheduler"):
        open_executor("processes", 2, cluster.address).__enter__()


def test_a_map_is_the_same_bytes_on_a_cluster(
    cluster: Cluster, scene: Path, tmp_path: Path
) -> None:
    few = {"local_features.options.max_keypoints": 400}
    for name, how in (("here", {}), ("cluster", {"scheduler": cluster.address})):
        megloc.build_map(scene / "mapping", set=few, workspace=tmp_path / name, **how)
    here = contents(tmp_path / "here")
    assert len(here) > 20
    assert contents(tmp_path / "cluster") == here


def test_images_are_localized_on_a_cluster_as_here(
    cluster: Cluster, scene: Path, tmp_path: Path
) -> None:
    few = {"local_features.options.max_keypoints": 400}
    built = megloc.build_map(scene / "mapping", set=few, workspace=tmp_path / "map")
    localizer = built.localizer()
    queries = list(KaptureQueries(KaptureFolder(scene / "query"), built.kapture_map))
    here = list(localizer.localize_many(queries))
    assert all(here)
    with open_executor("dask", scheduler=cluster.address) as executor:
        there = list(localizer.localize_many(queries, executor))
    for one, other in zip(here, there, strict=True):
        assert isinstance(one, Pose) and isinstance(other, Pose)
        assert one.cam_from_world.matrix().tobytes() == other.cam_from_world.matrix().tobytes()
        assert (one.name, one.confidence) == (other.name, other.confidence)


def whole(scene: Path) -> Given:
    """A whole run on a scene, with few keypoints."""
    return Given("kapture", scene, {"local_features.options.max_keypoints": 400})


@pytest.fixture(scope="module")
def inline(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, bytes], int]:
    """The files of a whole run in this process, and the number of results that it waits for."""
    root, counter = tmp_path_factory.mktemp("inline") / "workspace", At()
    whole(scene).run(root, track=counter)
    return contents(root), counter.results


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 4])
def test_workers_killed_at_ten_moments_change_no_byte(
    number: int, inline: tuple[dict[str, bytes], int], scene: Path, tmp_path: Path
) -> None:
    here, results = inline
    assert run_with_kills(whole(scene), tmp_path, number, results, seed=number) == 10
    assert contents(tmp_path / "workspace") == here


@pytest.mark.slow
def test_a_run_goes_on_after_its_scheduler_was_killed(
    inline: tuple[dict[str, bytes], int], scene: Path, tmp_path: Path
) -> None:
    here, results = inline
    assert resume_after_kills(whole(scene), tmp_path, results, seed=0) == 3
    assert contents(tmp_path / "workspace") == here

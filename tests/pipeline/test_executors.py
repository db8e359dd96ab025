"""Where work runs: inline, or in processes whose number changes nothing."""

from __future__ import annotations

import operator
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from megloc_kapture.errors import MeglocError, OptionError
from megloc_kapture.io.files import owned_name
from megloc_kapture.pipeline import executors
from megloc_kapture.pipeline.executors import available_cores, open_executor, single_threaded

# an OpenMP that an earlier test loaded within a block begins with one thread in every new thread,
# as the block's docstring says; which there are is known to the fixture below
_BEGIN_WITH_ONE: set[str] = set()


def threads() -> set[int]:
    """Numbers of threads of the loaded libraries that have a pool."""
    pools = [pool for pool in threadpool_info() if pool["filepath"] not in _BEGIN_WITH_ONE]
    return {pool["num_threads"] for pool in pools}


@dataclass(frozen=True)
class Item:
    """As stages have them."""

    image: str


def _until(item: Item, go: Path) -> str:
    while not go.exists():
        time.sleep(0.05)
    return item.image


def test_inline_and_one_worker_are_no_executor() -> None:
    for kind, workers in (("inline", None), ("inline", 8), ("processes", 1)):
        with open_executor(kind, workers) as executor:  # type: ignore[arg-type]
            assert executor is None


@pytest.mark.parametrize("workers", [0, -1])
def test_no_worker_is_refused(workers: int) -> None:
    with pytest.raises(OptionError, match=f"{workers} workers"), open_executor("inline", workers):
        pass


def test_workers_are_other_processes_with_one_thread_each() -> None:
    with open_executor("processes", 2) as executor:
        assert executor is not None
        assert executor.submit(os.getpid).result() != os.getpid()
        counts = {pool["num_threads"] for pool in executor.submit(threadpool_info).result()}
        assert counts == {1}


def _torch_threads() -> int:
    import torch

    return torch.get_num_threads()


def test_torch_has_one_thread_in_workers_and_within_a_block() -> None:
    with open_executor("processes", 2) as executor:
        assert executor is not None
        assert executor.submit(_torch_threads).result() == 1
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with single_threaded():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_torch_imported_within_a_block_has_one_thread_there_and_all_afterwards() -> None:
    script = """if True:
        from megloc_kapture.pipeline.executors import available_cores, single_threaded
        with single_threaded():
            import torch
            torch.zeros(1000, 1000).exp()  # something that starts its threads
            assert torch.get_num_threads() == 1, torch.get_num_threads()
        assert torch.get_num_threads() == available_cores(), torch.get_num_threads()
    """
    environment = {key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"}
    subprocess.run([sys.executable, "-c", script], check=True, env=environment)


def test_torch_imported_by_one_of_two_threads_in_blocks_has_one_thread_in_both() -> None:
    script = """if True:
        import threading
        from megloc_kapture.pipeline.executors import single_threaded
        inside, left = threading.Event(), threading.Event()
        def other():
            with single_threaded():
                inside.set()
                left.wait(30)
                seen.append(torch.get_num_threads())
            seen.append(torch.get_num_threads())
        seen = []
        thread = threading.Thread(target=other)
        with single_threaded():
            thread.start()
            assert inside.wait(30)
            import torch
        assert torch.get_num_threads() == 2, torch.get_num_threads()
        left.set()
        thread.join()
        assert seen == [1, 2], seen
    """
    environment = {**os.environ, "OMP_NUM_THREADS": "2"}
    subprocess.run([sys.executable, "-c", script], check=True, env=environment)


def test_a_worker_that_dies_is_told_in_one_line() -> None:
    with pytest.raises(MeglocError, match="a worker process died.*--workers"):  # noqa: SIM117
        with open_executor("processes", 2) as executor:
            assert executor is not None
            pid = executor.submit(os.getpid).result()
            os.kill(pid, signal.SIGKILL)
            executor.submit(abs, -1).result()
            executor.submit(abs, -1).result()


def test_an_error_in_a_worker_keeps_its_kind() -> None:
    with open_executor("processes", 2) as executor:
        assert executor is not None
        with pytest.raises(ValueError, match="invalid literal"):
            executor.submit(int, "x").result()


def test_an_error_does_not_wait_for_what_workers_are_at(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="of the block"):  # noqa: SIM117
        with open_executor("processes", 2) as executor:
            assert executor is not None
            pids = {executor.submit(os.getpid).result()}
            executor.submit(time.sleep, 600)
            raise ValueError("of the block")
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)


@pytest.fixture
def interruptible() -> Iterator[None]:
    """As in a terminal: what a shell starts behind ignores Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("within", ["forkserver.ensure_running", "_name_as_ours", "_WatchedPool"])
def test_ctrl_c_while_workers_are_made_ready_is_not_lost(
    interruptible: None, monkeypatch: pytest.MonkeyPatch, within: str
) -> None:
    do = operator.attrgetter(within)(executors)
    done = []

    def interrupted(*args: Any, **settings: Any) -> Any:
        os.kill(os.getpid(), signal.SIGINT)
        found = do(*args, **settings)
        done.append(found)
        return found

    monkeypatch.setattr(f"megloc_kapture.pipeline.executors.{within}", interrupted)
    with pytest.raises(KeyboardInterrupt), open_executor("processes", 2):
        pytest.fail("it went on")
    assert len(done) == 1, "what it was at was left half done"
    monkeypatch.undo()
    with open_executor("processes", 2) as pool:
        assert pool is not None and pool.submit(abs, -1).result() == 1


def test_workers_do_not_hear_ctrl_c(interruptible: None) -> None:
    for _ in range(2):  # the fork server of the first stays
        with open_executor("processes", 2) as pool:
            assert pool is not None
            (pid,) = {pool.submit(os.getpid).result()}
            os.kill(pid, signal.SIGINT)
            assert pool.submit(abs, -1).result() == 1
            assert pool.submit(signal.pthread_sigmask, signal.SIG_BLOCK, ()).result() == {
                signal.SIGINT
            }
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def wait_for(log: pytest.LogCaptureFixture, pattern: str) -> None:
    patience = time.monotonic() + 60
    while not re.search(pattern, log.text):
        assert time.monotonic() < patience, log.text
        time.sleep(0.05)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_a_silent_worker_is_named_and_so_is_a_stopped_one(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.setattr(executors, "_PATIENCE_S", 0.3)
    with open_executor("processes", 2) as executor:
        assert executor is not None
        # it may be holding the lock of the queue: then the other gets nothing to do either
        pid = executor.submit(os.getpid).result()
        os.kill(pid, signal.SIGSTOP)
        slow = [executor.submit(_until, Item(f"{k}.jpg"), tmp_path / "go") for k in range(2)]
        wait_for(caplog, rf"no result for .* minutes: .*process {pid} was stopped \(kill -CONT")
        os.kill(pid, signal.SIGCONT)
        wait_for(caplog, r"minutes: process \d+ is at [01].jpg; process \d+ is at [01].jpg\n")
        assert len(caplog.records) < 12  # the longer it lasts, the less often
        (tmp_path / "go").touch()
        assert [future.result() for future in slow] == ["0.jpg", "1.jpg"]


@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="semaphores are no files")
def test_what_the_dead_have_left_is_cleared_and_nothing_else() -> None:
    dead = subprocess.Popen(["true"])
    dead.wait()
    host = owned_name().removeprefix("megloc-").partition(".")[0]
    shared, temporary = Path("/dev/shm"), Path(tempfile.gettempdir())
    gone = [
        shared / f"sem.megloc-{host}.{dead.pid}-x",
        temporary / f"megloc-{host}.{dead.pid}-x",
        temporary / f".megloc-{host}.{dead.pid}-x",
    ]
    stay = [
        shared / f"sem.megloc-{host}.{os.getppid()}-x",
        temporary / f"megloc-00000x.{dead.pid}-x",
        temporary / f"megloc-{host}.notes",
    ]
    try:
        for path in (*gone, *stay):
            path.touch()
        with open_executor("processes", 2):
            assert not any(path.exists() for path in gone)
            assert all(path.exists() for path in stay)
    finally:
        for path in (*gone, *stay):
            path.unlink(missing_ok=True)


# ------------------------------------------------------------------ one thread in every thread


@pytest.fixture
def two_threads() -> Iterator[None]:
    """Two threads for every library, set by this thread, however many cores there are."""
    import torch

    before = torch.get_num_threads()
    with ThreadPoolExecutor(1) as new:
        pools = new.submit(threadpool_info).result()
    _BEGIN_WITH_ONE.update(p["filepath"] for p in pools if p["num_threads"] == 1)
    with threadpool_limits(limits=2):
        torch.set_num_threads(2)
        yield
        torch.set_num_threads(before)
    _BEGIN_WITH_ONE.clear()


def everywhere() -> set[int]:
    """Numbers of threads that a calculation of this thread gets, in BLAS, OpenMP and torch."""
    return threads() | {_torch_threads()}


def within_a_block() -> set[int]:
    with single_threaded():
        return everywhere()


@pytest.mark.usefixtures("two_threads")
def test_a_block_limits_the_thread_it_runs_in_after_another_thread_had_one() -> None:
    with ThreadPoolExecutor(1) as first, ThreadPoolExecutor(1) as second:
        for pool in (None, first, second, first):
            seen = within_a_block() if pool is None else pool.submit(within_a_block).result()
            assert seen == {1}
            assert everywhere() == {2}
            assert first.submit(everywhere).result() == {2}


@pytest.mark.usefixtures("two_threads")
def test_a_block_limits_although_this_thread_set_its_own_number() -> None:
    with threadpool_limits(limits=2):
        assert ThreadPoolExecutor(1).submit(within_a_block).result() == {1}
    with ThreadPoolExecutor(1) as pool, pool.submit(threadpool_limits, 2).result():
        assert within_a_block() == {1}


@pytest.mark.usefixtures("two_threads")
def test_blocks_may_be_nested() -> None:
    with single_threaded():
        with single_threaded():
            assert everywhere() == {1}
        assert everywhere() == {1}
    assert everywhere() == {2}
    with pytest.raises(KeyError), single_threaded(), single_threaded():
        raise KeyError
    assert everywhere() == {2}


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("main_leaves_first", [True, False])
def test_one_thread_while_any_block_is_open(main_leaves_first: bool) -> None:
    inside, leave, left, end = (threading.Event() for _ in range(4))
    seen: list[set[int]] = []

    def other() -> None:
        with single_threaded():
            inside.set()
            leave.wait(30)
            seen.append(everywhere())
        left.set()
        end.wait(30)  # a thread that lives on claims nothing
        seen.append(everywhere())

    thread = threading.Thread(target=other)
    with single_threaded():
        thread.start()
        assert inside.wait(30)
        assert everywhere() == {1}
        if not main_leaves_first:
            leave.set()
            assert left.wait(30)
            assert everywhere() == {1}
    leave.set()
    assert left.wait(30)
    assert everywhere() == {2}
    end.set()
    thread.join()
    assert seen == [{1}, {2}]


@pytest.mark.usefixtures("two_threads")
def test_threads_that_come_and_go_at_once_leave_the_numbers_as_they_were() -> None:
    with ThreadPoolExecutor(4) as pool:
        assert all(seen == {1} for seen in pool.map(lambda _: within_a_block(), range(200)))
        assert all(seen == {2} for seen in pool.map(lambda _: everywhere(), range(8)))
    assert everywhere() == {2}


@pytest.mark.usefixtures("two_threads")
def test_a_product_has_the_same_bytes_in_any_thread() -> None:
    """The size is one whose last bits depend on how OpenBLAS divides it."""
    a, b = np.random.default_rng(0).normal(size=(2, 500, 500))

    def product() -> bytes:
        with single_threaded():
            return (a @ b).tobytes()

    here = product()
    with ThreadPoolExecutor(2) as pool:
        assert {future.result() for future in [pool.submit(product) for _ in range(8)]} == {here}


def test_libraries_loaded_within_a_block_have_one_thread_there_and_all_afterwards() -> None:
    script = """if True:
        import numpy
        from threadpoolctl import threadpool_info
        from megloc_kapture.pipeline.executors import single_threaded
        def numbers():
            return {library["num_threads"] for library in threadpool_info()}
        loaded, before = len(threadpool_info()), numbers()
        with single_threaded():
            import scipy.linalg
            assert len(threadpool_info()) > loaded
            assert numbers() == {1}, numbers()
        assert numbers() == before, numbers()
    """
    for number in ("2", "2,1"):
        environment = {**os.environ, "OMP_NUM_THREADS": number}
        subprocess.run([sys.executable, "-c", script], check=True, env=environment)


def test_an_openblas_made_with_openmp_counts_for_each_thread() -> None:
    pytest.importorskip("faiss")  # brings one
    script = """if True:
        import threading
        import numpy, faiss
        from threadpoolctl import threadpool_info
        from megloc_kapture.pipeline.executors import single_threaded
        def numbers():
            return {library["num_threads"] for library in threadpool_info()}
        inside, leave = threading.Event(), threading.Event()
        seen = []
        def other():
            with single_threaded():
                seen.append(numbers())
                inside.set()
                leave.wait(30)
            seen.append(numbers())
        thread = threading.Thread(target=other)
        with single_threaded():
            thread.start()
            assert inside.wait(30)
        leave.set()
        thread.join()
        assert seen == [{1}, {2}], seen
        assert numbers() == {2}, numbers()
    """
    environment = {**os.environ, "OMP_NUM_THREADS": "2"}
    subprocess.run([sys.executable, "-c", script], check=True, env=environment)


def test_there_is_a_core_at_least() -> None:
    assert 1 <= available_cores() <= (os.cpu_count() or 1)

"""A study in local processes and on a Dask cluster: the same numbers as in this process, also where workers die."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time

import pytest
import tiny_study
from tiny_study import Counting, summary

from semstab.api import run_study
from semstab.engine import DaskCluster, LocalProcesses
from semstab.engine.observer import Observers
from semstab.engine.units import make_plan
from semstab.engine.work import Start, Work
from semstab.errors import ConfigError, MissingDependencyError

MODELS = ("a", "b", "c", "d")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tiny_study.write(tmp_path_factory.mktemp("scene") / "wall", models=MODELS)


@pytest.fixture(scope="module")
def config(root):
    """Eight units in four jobs."""
    return tiny_study.configure(root, sweeps={"voxel_size": [0.5]}, backends=["numpy"])


@pytest.fixture(scope="module")
def expected(config, tmp_path_factory):
    """The numbers of the study in this process."""
    out = tmp_path_factory.mktemp("expected")
    run_study(config, out, report=False)
    return summary(out)


def children(parent: int | None = None) -> set[int]:
    """The worker processes of this process, or of another."""
    command = ["ps", "-ww", "-o", "pid=,args=", "--ppid", str(parent or os.getpid())]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    return {int(line.split()[0]) for line in found.stdout.splitlines() if "spawn_main" in line}


def gone(process: int) -> bool:
    with contextlib.suppress(OSError):
        os.kill(process, 0)
        with open(f"/proc/{process}/stat") as stat:  # noqa: PTH123 - gone at any moment
            return stat.read().rpartition(")")[2].split()[0] == "Z"
    return True


def wait_until(condition, seconds: float = 30, step: float = 0.05) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(step)


class Killing(Counting):
    """Kills one of the workers when the first unit is finished."""

    def __init__(self, worker) -> None:
        super().__init__()
        self.worker = worker

    def unit_finished(self, cell, content, table, error) -> None:
        super().unit_finished(cell, content, table, error)
        if self.worker is not None:
            process, self.worker = self.worker(), None
            os.kill(process, signal.SIGKILL)


def test_local_processes_give_the_same_numbers_though_one_is_killed(config, tmp_path, expected) -> None:
    killing = Killing(lambda: min(children()))
    result = run_study(config, tmp_path / "out", executor=LocalProcesses(2), observers=[killing], report=False)
    assert result.failures == ()
    assert summary(tmp_path / "out") == expected
    assert result.manifest["units"]["executor"] == "2 local processes"
    assert len(killing.computed) == killing.units
    assert children() == set()
    again = Counting()
    run_study(config, tmp_path / "out", executor=LocalProcesses(2), observers=[again], report=False)
    assert again.computed == []


class Deadly(Work):
    """A work whose process dies of it."""

    def __reduce__(self):
        return os._exit, (1,)


def test_a_job_that_kills_its_process_fails_and_the_others_finish(root, tmp_path) -> None:
    config = tiny_study.configure(root, sweeps={}, backends=["numpy"], models=["a"])
    start = Start("start", tmp_path)
    (fine,) = [Work.from_unit(cell, start) for cell in make_plan(config).units]
    deadly = Deadly(start, dataclasses.replace(fine.unit, identity="deadly"), range(1))
    jobs = iter([(deadly,), (fine,)])
    done = {
        done_unit.unit.identity: done_unit
        for done_unit in LocalProcesses(1).run(lambda: next(jobs, None), Observers([]))
    }
    assert len(done) == 2
    assert done["deadly"].error.startswith("its process was killed, perhaps because memory ran out")
    assert done[fine.unit.identity].error is None


def test_worker_processes_end_with_a_parent_that_was_killed(tmp_path) -> None:
    (tmp_path / "parent.py").write_text(
        "import pathlib\n"
        "from semstab.engine import LocalProcesses\n"
        "from semstab.engine.observer import Observers\n"
        "from semstab.engine.work import Start, Work\n"
        "class Endless(Work):\n"
        "    def __reduce__(self):\n"
        "        return exec, ('import pathlib, time; pathlib.Path(\"at work\").touch(); time.sleep(600)',)\n"
        "if __name__ == '__main__':\n"
        "    jobs = iter([(Endless(Start('start', pathlib.Path('out')), None, range(1)),)])\n"
        "    list(LocalProcesses(1).run(lambda: next(jobs, None), Observers([])))\n"
    )
    with subprocess.Popen([sys.executable, "parent.py"], cwd=tmp_path) as parent:
        wait_until((tmp_path / "at work").exists)
        (worker,) = children(parent.pid)
        parent.kill()
    wait_until(lambda: gone(worker))


def test_a_script_without_a_main_guard_is_told_so(tmp_path) -> None:
    (tmp_path / "script.py").write_text(
        "import pathlib\n"
        "from semstab.engine import LocalProcesses\n"
        "from semstab.engine.observer import Observers\n"
        "from semstab.engine.work import Start, Work\n"
        "jobs = iter([(Work(Start('start', pathlib.Path('out')), None, range(1)),)])\n"
        "list(LocalProcesses(1).run(lambda: next(jobs, None), Observers([])))\n"
    )
    result = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "call it under if __name__ == '__main__'" in result.stderr


def test_executors_that_cannot_be_used_say_why(monkeypatch) -> None:
    with pytest.raises(ConfigError, match="0 jobs: use 1 or more"):
        LocalProcesses(0)
    pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    monkeypatch.setattr("semstab.engine.executors.CONNECT_SECONDS", 0.5)
    with pytest.raises(ConfigError, match=r"tcp://127\.0\.0\.1:9: no Dask scheduler answers"):
        DaskCluster("tcp://127.0.0.1:9")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'semstab\[cluster\]'"):
        DaskCluster("tcp://127.0.0.1:9")


@contextlib.contextmanager
def dask(*command: str):
    """A process of a cluster; it ends with the block."""
    process = subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.dask_{command[0]}", "--host", "127.0.0.1", *command[1:]],
        stderr=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def cluster(tmp_path):
    """The address of a scheduler with two workers, its process and the workers'."""
    distributed = pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    file = tmp_path / "scheduler.json"
    arguments = ("--scheduler-file", str(file), "--no-dashboard")
    with dask("scheduler", "--port", "0", *arguments) as scheduler:
        wait_until(file.exists)
        quiet = ("worker", "--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path), *arguments)
        with dask(*quiet) as first, dask(*quiet) as second:
            address = json.loads(file.read_text())["address"]
            with distributed.Client(address, set_as_default=False) as client:
                client.wait_for_workers(2, timeout=30)
            yield address, scheduler, (first, second)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_a_dask_cluster_gives_the_same_numbers_though_a_worker_is_killed(
    config, tmp_path, expected, cluster, monkeypatch
) -> None:
    """Without its scheduler, which is killed as well then, it says in one line that jobs are left."""
    address, scheduler, workers = cluster
    killing = Killing(lambda: workers[0].pid)
    result = run_study(config, tmp_path / "out", executor=DaskCluster(address), observers=[killing], report=False)
    assert workers[0].wait(10) == -signal.SIGKILL
    assert result.failures == ()
    assert summary(tmp_path / "out") == expected
    assert result.manifest["units"]["executor"] == "Dask, 2 threads"

    monkeypatch.setattr("semstab.engine.executors.CONNECT_SECONDS", 1)  # after which it is given up
    executor = DaskCluster(address)
    jobs = iter([(Work.from_unit(make_plan(config).units[0], Start("start", tmp_path)),)] * 9)
    finished = executor.run(lambda: next(jobs, None), Observers([]))
    next(finished)
    scheduler.kill()
    with pytest.raises(ConfigError, match="the scheduler does not answer any more; start it again"):
        list(finished)
    executor.close()

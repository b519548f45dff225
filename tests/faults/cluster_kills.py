"""Kill the scheduler, a worker or the command itself while a map is fused in tiles on a Dask cluster of two workers.

    python tests/faults/cluster_kills.py [COUNT [SEED]]         5 of each by default

Without its scheduler a command must end, in one line, with 2; without a worker it must come to a good end. Then what is
gone is started again and the same command has to leave what one without a kill leaves.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import tiny_scene
from kills import of_run

PORT = 8797
ADDRESS = f"tcp://127.0.0.1:{PORT}"
PATIENCE = 120


class Cluster:
    """A scheduler and two workers, started where they are not there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self) -> None:
        """What is not running."""
        from distributed import Client

        if self.gone("scheduler"):  # workers leave with it
            self.stop()
            self.begin("scheduler", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(PORT))
        quiet = ("--nthreads", "1", "--no-nanny", "--local-directory", str(self.folder / "dask"))
        for name in ("first", "second"):
            if self.gone(name):
                self.begin(name, "distributed.cli.dask_worker", ADDRESS, *quiet)
        with Client(ADDRESS, set_as_default=False, timeout=60) as client:
            client.wait_for_workers(2, timeout=60)

    def gone(self, name: str) -> bool:
        """Whether it does not run."""
        return name not in self.processes or self.processes[name].poll() is not None

    def begin(self, name: str, module: str, *words: str) -> None:
        """Start a process."""
        with (self.folder / f"{name}.log").open("a") as log:
            self.processes[name] = subprocess.Popen(
                [sys.executable, "-m", module, "--no-dashboard", *words], stdout=log, stderr=log
            )

    def stop(self) -> None:
        """All of it."""
        for process in self.processes.values():
            process.kill()
            process.wait()


def command(scene: Path, out: Path) -> subprocess.Popen[str]:
    """A run in tiles on the cluster."""
    words = ["--data", str(scene), "--backend", "numba", "--voxel-size", "0.1", "--tile-size", "8", "--out", str(out)]
    words += ["--quiet", "--report", "off", "--rerun", "off", "--scheduler", ADDRESS]
    return subprocess.Popen([sys.executable, "-m", "semstab", "run", *words], stderr=subprocess.PIPE, text=True)


def ended(process: subprocess.Popen[str]) -> tuple[int, list[str]]:
    """Its exit code and what it said."""
    said = process.communicate(timeout=PATIENCE)[1]
    return process.returncode, [line for line in said.splitlines() if "fused in" not in line]


def main(count: int, seed: int) -> None:
    """Kill so many of each, every second one while parts are finished, and fail where one did not end as it should."""
    rng, wrong = random.Random(seed), []
    with tempfile.TemporaryDirectory() as temporary:
        base = Path(temporary)
        scene = tiny_scene.write(base / "wall", backbones=("a",), frames=200)
        cluster = Cluster(base)
        try:
            cluster.start()
            started = time.monotonic()
            assert ended(command(scene, base / "whole")) == (0, [])
            seconds = time.monotonic() - started
            expected = of_run(base / "whole")
            for k in range(3 * count):
                who, out = ("scheduler", "first", "command")[k % 3], base / f"run{k}"
                running, started = command(scene, out), time.monotonic()
                while k % 2 and running.poll() is None and not any(out.glob("tiles/*/*.npz")):
                    time.sleep(0.01)  # every second time once something is finished
                time.sleep(rng.random() * seconds * (0.1 if k % 2 else 1))
                moment = time.monotonic() - started
                victim = running if who == "command" else cluster.processes[who]
                os.kill(victim.pid, signal.SIGKILL)
                victim.wait()
                code, said = ended(running)
                kept = len(list(out.glob("tiles/*/*.npz")))
                good = {"scheduler": (0, 2), "first": (0,), "command": (0, -signal.SIGKILL)}[who]
                if code not in good or len(said) > 1:
                    wrong.append(f"{who} {k}: killed at {moment:.2f} s, ended with {code}: {said}")
                cluster.start()
                again = ended(command(scene, out))
                if again != (0, []) or json.dumps(of_run(out)) != json.dumps(expected):
                    wrong.append(f"{who} {k}: killed at {moment:.2f} s, differs after {again}")
                print(f"{who:9} killed at {moment:5.2f} of {seconds:.2f} s: {code}, {kept} portions kept; {said}")
        finally:
            cluster.stop()
    print(f"{3 * count - len(wrong)} of {3 * count} ended well", *wrong, sep="\n")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main(*map(int, (*sys.argv[1:], *("5", "0")[len(sys.argv) - 1 :])))

"""Random faults of a fleet: every result has the bytes of a serial run, and the same command goes on."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import threading

import pytest

pytest.importorskip("distributed", reason="the extra fleet is not installed")

import fleet_nodes
from distributed import Client
from fleet_nodes import children, contents, scheduler
from reliability import tell, times

from graph_slam_ros.tools.fleet.replay import Fleet, replay_all

COUNT = 12
DAMAGE = (b"", b"nothing", b"\x89MCAP0\r\n" + bytes(100))
pytestmark = pytest.mark.skipif(not times(0, 1), reason="takes minutes: make soak")


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """Bytes of the results of recordings, replayed one by one; three more are damaged, one of them cut off."""
    folder = tmp_path_factory.mktemp("fleet") / "drives"
    folder.mkdir()
    return folder, fleet_nodes.drives(folder, COUNT, *DAMAGE)


@pytest.fixture(scope="module")
def drives(serial):
    return serial[0]


def check(out, rows, serial):
    """No result is wrong; return the recordings that have one."""
    done = {row["recording"]: contents(out / "jobs" / row["key"] / "run") for row in rows if row["state"] == "done"}
    assert done == {name: serial[1][name] for name in done}
    assert all(row["reason"] for row in rows if row["state"] != "done")
    return set(done)


def whole(drives, out, serial, workers=2):
    """The same command again has all results, and leaves nothing half-written."""
    rows = replay_all(Fleet([str(drives)], out), workers=workers)[0]
    assert check(out, rows, serial) == set(serial[1])
    assert sum(row["state"] == "failed" for row in rows) == len(DAMAGE)
    assert not list(out.glob("jobs/.*"))


def begun(drives, out, *options):
    command = [sys.executable, "-m", "graph_slam_ros.cli", "fleet", "replay", str(drives), "--out", str(out), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_fleet_that_is_killed_at_any_moment_goes_on(drives, serial, tmp_path):
    stops = 10
    for seed in range(stops):
        process = begun(drives, tmp_path / "out", "--workers", "2")
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=random.Random(seed).uniform(2.0, 6.0))
        process.kill()
        process.communicate()
    whole(drives, tmp_path / "out", serial)
    tell("fleets killed, and begun again", killed=stops)


@pytest.mark.parametrize("seed", range(5))
def test_random_faults_of_workers_over_tcp_change_no_result(drives, serial, tmp_path, seed):
    """Workers and runs are killed, and runs are stopped, which is a hang; the limit of time is 8 s."""
    chance, over, faults = random.Random(seed), threading.Event(), []
    with scheduler(tmp_path, 4) as (address, _), Client(address, set_as_default=False) as client:
        client.wait_for_workers(4, timeout=120)

        def disturb():
            while not over.wait(chance.uniform(0.5, 4.0)):
                worker = chance.choice(list(client.run(os.getpid).values()))
                kind, victims = chance.choice(["worker", "run", "hang"]), children(worker)
                victim = worker if kind == "worker" or not victims else chance.choice(victims)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(victim, signal.SIGSTOP if kind == "hang" and victim != worker else signal.SIGKILL)
                    faults.append(kind)

        disturber = threading.Thread(target=disturb)
        disturber.start()
        try:
            rows = replay_all(Fleet([str(drives)], tmp_path / "out", limit_s=8.0), address)[0]
        finally:
            over.set()
            disturber.join()
    check(tmp_path / "out", rows, serial)
    assert len(rows) == COUNT + len(DAMAGE), "none is without a row"
    whole(drives, tmp_path / "out", serial)
    tell("faults of workers over TCP", **{kind: faults.count(kind) for kind in set(faults)})

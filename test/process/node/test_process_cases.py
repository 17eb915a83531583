"""What may happen to the process of the node, which is in this one, so that its solver can be made to fail."""

import contextlib
import itertools
import subprocess
import sys
import threading

import numpy as np
import pytest
from live_drive import Drive, distance
from live_nodes import ENVIRONMENT, numbers, replayed, results, robot, until
from rclpy.clock import ClockType, JumpThreshold
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.time import Time

from graph_slam_ros.node.node import GraphSlamNode
from graph_slam_ros.node.pose_extrapolator import PoseExtrapolator
from graph_slam_ros.node.session import Session
from graph_slam_ros.runs.folder import is_cut_off, is_incomplete, was_saved_whole
from graph_slam_ros.runs.journal import read_ingest
from graph_slam_ros.runs.restore import complete, recover
from graph_slam_ros.slam import GraphSlam
from graph_slam_ros.solver import Solver

HEARS = "/diagnostics", "/tf", "pose"
NUMBERS = itertools.count()  # of nodes: who was there before in this process may be heard for a while


@contextlib.contextmanager
def inside(namespace, **values):
    """A node at work in this process."""
    context = Context()
    context.init(args=[], domain_id=int(ENVIRONMENT["ROS_DOMAIN_ID"]))
    given = {"output.folder": "", "inputs.reliable": True} | {k.replace("__", "."): v for k, v in values.items()}
    parameters = [Parameter(k, value=v) for k, v in given.items()]
    slam = GraphSlamNode(context=context, namespace=namespace, parameter_overrides=parameters)
    executor, ended = SingleThreadedExecutor(context=context), threading.Event()
    executor.add_node(slam)

    def spin():
        while not ended.is_set():
            executor.spin_once(timeout_sec=0.1)

    thread = threading.Thread(target=spin, daemon=True)
    try:
        slam.trigger_configure()
        slam.trigger_activate()
        thread.start()
        yield slam
    finally:
        ended.set()
        thread.join(10.0)
        slam.finish(1.0)
        executor.shutdown()
        slam.destroy_node()
        context.try_shutdown()


@contextlib.contextmanager
def at_work(hears=HEARS, **values):
    """A node at work that is well, the robot that it hears, and its drive."""
    namespace = f"/robot_{next(NUMBERS)}"
    with inside(namespace, **values) as slam, robot(of=f"{namespace}/graph_slam", hears=hears) as r:
        r.wait_for_node()
        drive = Drive()
        r.until_it_says("OK", spin=drive.pace(r))
        until(lambda: len(r.heard["pose"]) > 3, drive.pace(r), "poses")
        yield slam, r, drive


@contextlib.contextmanager
def held(monkeypatch):
    """Until the end no solve ends."""
    gate, update = threading.Event(), Solver.update
    with monkeypatch.context() as patched:
        patched.setattr(Solver, "update", lambda self: gate.wait(60.0) and update(self))
        try:
            yield
        finally:
            gate.set()


def counted(r, name, reason):
    """Of an input, by the last of /diagnostics."""
    said = r.said(f"input {name}")
    return int(said[-1][1].get(f"counted: {reason}", 0)) if said else 0


def faults(run):
    """What callbacks raised, by what was saved."""
    return numbers(run)["counters"].get("node", {})


def test_P9_P10_P17_where_a_solve_does_not_end_it_says_so_refuses_what_is_too_much_and_goes_on(tmp_path, monkeypatch):
    run = tmp_path / "run"
    with at_work(health__stuck_s=0.5, inputs__queue=20, output__folder=str(run)) as (_, r, drive):
        with held(monkeypatch):
            r.until_it_says("DEGRADED", "solver stuck", spin=drive.pace(r))
            r.heard["tf"].clear()
            until(lambda: len(r.heard["tf"]) > 20, drive.pace(r), "transforms")
            r.until_it_says("DEGRADED", "messages refused: the queue is full", spin=drive.pace(r))
            assert int(r.said()[-1][1]["messages waiting"]) <= 21
            assert r.set({"keyframes.min_distance_m": 2.5}) == (True, "")
        r.until_it_says("OK", spin=drive.pace(r))
        until(lambda: counted(r, "odom", "overflow") > 50, drive.pace(r), "their count")
        r.settle()
        r.save_in_turn()
        assert was_saved_whole(run)
    assert results(run) == replayed(run, tmp_path), "the parameter has its place among what waited"


def test_P11_a_robot_that_has_gone_and_comes_back_is_heard_again():
    """Its participant is a new one, as after a restart of its middleware."""
    with at_work() as (slam, r, drive):
        r.close()
        with robot(of=slam.get_fully_qualified_name(), hears=HEARS) as again:
            again.wait_for_node()
            again.until_it_says("OK", spin=drive.pace(again))
            until(lambda: len(again.heard["pose"]) > 3, drive.pace(again), "poses")
            again.until_graph(drive.pace(again), segments=1)


def test_G7_P21_P23_solves_that_fail_faults_of_callbacks_and_the_end_of_its_thread_are_said_and_it_goes_on(
    tmp_path, monkeypatch, capfd
):
    with at_work(output__folder=str(tmp_path / "run")) as (_, r, drive):
        with monkeypatch.context() as patched:

            def fail(*arguments, **words):
                raise MemoryError("no room")

            for name in ("update", "optimize"):
                patched.setattr(Solver, name, fail)
            why = "solves fail, the last good estimate stands", "MemoryError: no room"
            r.until_it_says("DEGRADED", *why, spin=drive.pace(r))
            r.heard["tf"].clear()
            until(lambda: len(r.heard["tf"]) > 20, drive.pace(r), "transforms by the last good estimate")
        r.until_it_says("OK", spin=drive.pace(r))

        before, process = r.graph()["keyframes"], GraphSlam.process

        def dies(self, measurement):
            monkeypatch.setattr(GraphSlam, "process", process)
            raise SystemExit

        monkeypatch.setattr(GraphSlam, "process", dies)
        until(lambda: GraphSlam.process is process, drive.pace(r), "what would end the thread")
        until(lambda: r.graph()["keyframes"] > before + 5, drive.pace(r), "keyframes of the graph that there is")
        r.until_it_says("OK", spin=drive.pace(r))

        capfd.readouterr()
        with monkeypatch.context() as patched:
            patched.setattr(Session, "process", lambda *_: 1 // 0)
            drive.go(r, 5)
            r.settle()
            assert not r.verdict.startswith("ERROR")
            r.until_it_says("ERROR", "faults in callbacks in 10 s", spin=drive.pace(r), patience_s=20.0)
        assert capfd.readouterr().err.count("Traceback") == 1
        assert r.save().success
    assert faults(tmp_path / "run")["worker_restarted"] == 1


def test_A37_P6_behind_it_tells_what_there_is_and_stopped_then_the_next_start_makes_the_results(
    tmp_path, monkeypatch, capfd
):
    run, gate, update = tmp_path / "run", threading.Event(), Solver.update
    slow, kind = {"keyframes__min_distance_m": 0.02, "output__folder": str(run)}, ("path", "landmarks")
    with monkeypatch.context() as patched, at_work(hears=(*HEARS, *kind), **slow) as (_, r, drive):
        patched.setattr(Solver, "update", lambda self: gate.wait(0.2) or update(self))

        def press(seconds):
            """Faster than it can solve."""
            drive.step(r)
            r.spin(seconds / 4)

        def lag_s():
            return float(r.said()[-1][1]["lag [s]"])

        until(lambda: lag_s() > 2.0, press, "backlog")
        for name in kind:
            r.heard[name].clear()
        until(lambda: all(r.heard[name] for name in kind), press, "results while messages wait")
        sigmas = np.sqrt(np.diag(r.heard["pose"][-1].pose.covariance.reshape(6, 6)))
        assert sigmas[[2, 3, 4]] == pytest.approx(0.5), "what the plane leaves open can be drawn"
        until(lambda: lag_s() > 2.0, press, "backlog")
        used = int(r.said("input odom")[-1][1]["measurements used"])
    gate.set()
    assert "measurements waited: all are in the journal" in capfd.readouterr().err
    records = list(read_ingest(run, losses := []))
    odometry = [one["stamp_ns"] for one in records if one["type"] == "odometry"]
    assert losses == [] and len(odometry) >= used > 10
    summary = numbers(run)
    assert summary["ended"] and summary["unprocessed"] > 0 and max(summary["load"]["backlog"]) > 0
    assert is_incomplete(run) and not is_cut_off(run), "somebody ended it"
    recover(run, tmp_path / "recovered")
    path, whole = np.loadtxt(tmp_path / "recovered" / "path.tum"), Drive(odometry[0])
    assert odometry[-1] - path[-1, 0] * 1e9 < 10**9
    while whole.stamp_ns < path[-1, 0] * 1e9 - 1e6:
        whole.move()
    assert distance(path[-1, 1:3], whole.truth) < 0.2
    with inside("/next", output__folder=str(run)):
        assert f"graph_slam recover {(earlier := tmp_path / 'run-1')}" in capfd.readouterr().err
    assert complete(earlier) and not is_incomplete(earlier)
    assert abs(np.loadtxt(earlier / "path.tum")[-1, 0] * 1e9 - odometry[-1]) < 10**9


def test_B15_what_is_raised_after_a_jump_reaches_nobody_and_is_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(PoseExtrapolator, "forget", lambda self: 1 // 0)
    called, run = [], tmp_path / "run"
    with inside("/jumps", use_sim_time=True, output__folder=str(run)) as slam:
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
        after = slam.get_clock().create_jump_callback(back, post_callback=called.append)
        with robot(of="/jumps/graph_slam", hears=("pose",)) as r:
            r.wait_for_node()
            for seconds in (5_100, 5_040):
                slam.get_clock().set_ros_time_override(Time(seconds=seconds, clock_type=ClockType.ROS_TIME))
                r.heard["pose"].clear()
                until(lambda: r.heard["pose"], Drive(5_000 * 10**9).pace(r), "pose")
            assert r.save().success
        after.unregister()
    assert len(called) == 1, "those who come after it are called"
    assert faults(run)["ZeroDivisionError"] == 1


def test_P24_numpy_has_one_thread_in_the_node():
    """As many threads in all as where one is asked for."""
    code = "import graph_slam_ros.node.node, pathlib; print(len(list(pathlib.Path('/proc/self/task').iterdir())))"
    nothing_said = {k: v for k, v in ENVIRONMENT.items() if not k.endswith("_NUM_THREADS")}

    def threads(**said):
        command = [sys.executable, "-c", code]
        return int(subprocess.run(command, env=nothing_said | said, capture_output=True, text=True, check=True).stdout)

    assert threads() == threads(OPENBLAS_NUM_THREADS="1")

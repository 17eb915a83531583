"""What may happen to the process of the node: faults of its threads, memory, load; what it then does, and says.

The node is in this process, with a thread of its own for its callbacks, so that its solver can be made to fail.
"""

import contextlib
import gc
import itertools
import subprocess
import sys
import threading

import pytest
from live_drive import Drive
from live_nodes import ENVIRONMENT, own_domain, replayed, results, robot, until
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter

from graph_slam_ros.measurements.types import Closure
from graph_slam_ros.node.memory import resident_mib
from graph_slam_ros.node.node import GraphSlamNode
from graph_slam_ros.node.session import Session
from graph_slam_ros.node.worker import Worker
from graph_slam_ros.slam import GraphSlam

HEARS = "/diagnostics", "/tf", "pose"
NUMBERS = itertools.count()  # of nodes: who was there before in this process may be heard for a while


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    """Of each test its own: what is left of others says nothing here."""
    with own_domain() as number:
        monkeypatch.setitem(ENVIRONMENT, "ROS_DOMAIN_ID", number)
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


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
def at_work(**values):
    """A node at work that is well, the robot that it hears, and its drive."""
    namespace = f"/robot_{next(NUMBERS)}"
    with inside(namespace, **values) as slam, robot(of=f"{namespace}/graph_slam", hears=HEARS) as r:
        r.wait_for_node()
        drive = Drive()
        r.until_it_says("OK", spin=drive.pace(r))
        until(lambda: len(r.heard["pose"]) > 3, drive.pace(r), "poses")
        yield slam, r, drive


@contextlib.contextmanager
def held(slam):
    """Until the end no solve ends."""
    gate, solver = threading.Event(), slam._run._session.slam.solver
    update = solver.update

    def hold():
        gate.wait(60.0)
        return update()

    solver.update = hold
    try:
        yield
    finally:
        gate.set()
        del solver.update


def test_a_node_that_is_destroyed_is_seen_by_nobody_from_then_on():
    gc.disable()  # which would end what still keeps it
    try:
        with robot(of="/gone/graph_slam", hears=()) as r:

            def is_seen():
                return ("graph_slam", "/gone") in r.node.get_node_names_and_namespaces()

            with inside("/gone") as slam:
                until(is_seen, r.spin, "node")
                slam.destroy_node()  # and once more at the end
            until(lambda: not is_seen(), r.spin, "end of the node")
            r.settle(1.0)
            assert not is_seen()
        with robot(of="/gone/graph_slam", hears=(), name="later") as r:
            r.settle(2.0)
            assert ("graph_slam", "/gone") not in r.node.get_node_names_and_namespaces()
    finally:
        gc.enable()


def test_P9_where_a_solve_does_not_end_it_says_so_and_transforms_go_on():
    with at_work(health__stuck_s=0.5) as (slam, r, drive):
        with held(slam):
            r.until_it_says("DEGRADED", "solver stuck", spin=drive.pace(r))
            r.heard["tf"].clear()
            until(lambda: len(r.heard["tf"]) > 20, drive.pace(r), "transforms")
        r.until_it_says("OK", spin=drive.pace(r))


def test_P10_what_does_not_fit_into_the_queue_is_refused_before_it_is_accepted_and_soon_all_is_well(tmp_path):
    with at_work(inputs__queue=20, output__folder=str(tmp_path / "run")) as (slam, r, drive):
        run = slam._run
        with held(slam):
            drive.go(r, 200)
            until(lambda: run.counters["odom", "overflow"] > 50, r.spin, "refusals")
            r.until_it_says("DEGRADED", "messages refused: the queue is full", spin=drive.pace(r))
            assert run._worker.waiting <= 21
        r.until_it_says("OK", spin=drive.pace(r))
        r.save_all(tmp_path / "run")
        assert results(tmp_path / "run") == replayed(tmp_path / "run", tmp_path)


def test_P17_a_parameter_that_is_set_during_a_solve_takes_effect_after_it(tmp_path):
    with at_work(output__folder=str(tmp_path / "run")) as (slam, r, drive):
        session = slam._run._session
        with held(slam):
            until(lambda: slam._run._worker.waiting > 3, drive.pace(r), "measurements that wait")
            assert r.set({"keyframes.min_distance_m": 2.5}) == (True, "")
            assert session.slam.config.keyframes.min_distance_m < 2.5
        until(lambda: session.slam.config.keyframes.min_distance_m == 2.5, drive.pace(r), "the new value")
        r.save_all(tmp_path / "run")
        assert results(tmp_path / "run") == replayed(tmp_path / "run", tmp_path)


def test_P11_a_robot_that_has_gone_and_comes_back_is_heard_again():
    """Its participant is a new one, as after a restart of its middleware."""
    with at_work() as (slam, r, drive):
        r.close()
        with robot(of=slam.get_fully_qualified_name(), hears=HEARS) as again:
            again.wait_for_node()
            again.until_it_says("OK", spin=drive.pace(again))
            until(lambda: len(again.heard["pose"]) > 3, drive.pace(again), "poses")
            again.until_graph(drive.pace(again), segments=1)


def test_G7_while_solves_fail_it_says_so_and_why_and_transforms_go_on_by_the_last_good_estimate():
    with at_work() as (slam, r, drive):
        session = slam._run._session
        solver = session.slam.solver

        def fail(*arguments):
            raise MemoryError("no room")

        solver.update = solver.optimize = fail
        r.until_it_says(
            "DEGRADED", "solves fail, the last good estimate stands", "MemoryError: no room", spin=drive.pace(r)
        )
        r.heard["tf"].clear()
        until(lambda: len(r.heard["tf"]) > 20, drive.pace(r), "transforms")
        del solver.update, solver.optimize
        r.until_it_says("OK", spin=drive.pace(r))
        assert session.slam.counters["solver", "MemoryError"] > 0


def test_P7_above_its_limit_of_memory_closures_are_refused_and_counted_and_below_taken_again(tmp_path):
    with at_work(output__folder=str(tmp_path / "run")) as (slam, r, drive):
        run, backend = slam._run, slam._run._session.slam.backend
        assert r.set({"health.memory_mib": 0.5 * resident_mib()}) == (True, "")
        r.until_it_says("DEGRADED", "health.memory_mib", spin=drive.pace(r))
        closure = Closure(
            drive.stamp_ns, drive.stamp_ns - 10**9, "/closures", (0.0, 0.0, 0.0), (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0)
        )
        run._ingest.receive([closure], b"")
        assert run.counters["/closures", "memory"] == 1
        until(lambda: backend.spares_memory, drive.pace(r), "no second looks")
        assert r.set({"health.memory_mib": 10.0 * resident_mib()}) == (True, "")
        r.until_it_says("OK", spin=drive.pace(r))
        until(lambda: not backend.spares_memory, drive.pace(r), "second looks")
        run._ingest.receive([closure], b"")
        assert run.counters["/closures", "memory"] == 1
        r.save_all(tmp_path / "run")
        assert results(tmp_path / "run") == replayed(tmp_path / "run", tmp_path)


def test_P23_what_would_end_the_solvers_thread_does_not_and_it_goes_on_with_the_graph_that_there_is(monkeypatch):
    with at_work() as (slam, r, drive):
        run = slam._run
        slam_before, before = run._session.slam, len(run._session.slam.keyframes)
        process = GraphSlam.process

        def dies(self, measurement):
            monkeypatch.setattr(GraphSlam, "process", process)
            raise SystemExit

        monkeypatch.setattr(GraphSlam, "process", dies)
        until(lambda: run.counters["node", "worker_restarted"] == 1, drive.pace(r), "the counter")
        r.until_it_says("OK", spin=drive.pace(r))
        until(lambda: len(run._session.slam.keyframes) > before + 5, drive.pace(r), "keyframes")
        assert run._session.slam is slam_before
        assert run._worker.is_alive
        assert not slam_before.failing


def test_P23_who_waits_for_a_job_that_would_have_ended_its_thread_is_told():
    done = []
    worker = Worker(10, print, lambda: done.append("first"))

    def ends():
        raise SystemExit

    future, after = worker.call(ends), worker.call(lambda: done.append("after"))
    with pytest.raises(RuntimeError, match="SystemExit"):
        future.result(10.0)
    after.result(10.0)
    with pytest.raises(ZeroDivisionError):
        worker.call(lambda: 1 // 0).result(10.0)
    assert done == ["first", "after"]
    assert worker.stop(10.0)


def test_P21_exceptions_of_callbacks_are_counted_told_once_and_an_error_from_a_hundred_on(monkeypatch, capfd):
    with at_work() as (slam, r, drive):
        process = Session.process
        monkeypatch.setattr(Session, "process", lambda *_: 1 // 0)
        for _ in range(5):
            drive.step(r)
        until(lambda: slam._run.counters["node", "ZeroDivisionError"] > 4, r.spin, "faults")
        assert r.verdict.state != "ERROR"
        r.until_it_says("ERROR", "faults in callbacks in 10 s", spin=drive.pace(r), patience_s=20.0)
        monkeypatch.setattr(Session, "process", process)
        r.heard["pose"].clear()
        until(lambda: r.heard["pose"], drive.pace(r), "poses")
    assert capfd.readouterr().err.count("Traceback") == 1


def test_P24_numpy_has_one_thread_in_the_node():
    """As many threads in all as where one is asked for, and fewer than where two are."""
    code = "import graph_slam_ros.node.node, pathlib; print(len(list(pathlib.Path('/proc/self/task').iterdir())))"
    nothing_said = {k: v for k, v in ENVIRONMENT.items() if not k.endswith("_NUM_THREADS")}

    def threads(**said):
        command = [sys.executable, "-c", code]
        return int(subprocess.run(command, env=nothing_said | said, capture_output=True, text=True, check=True).stdout)

    assert threads() == threads(OPENBLAS_NUM_THREADS="1") < threads(OPENBLAS_NUM_THREADS="2")

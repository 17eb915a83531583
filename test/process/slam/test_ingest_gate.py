"""The gate in front of the pipeline: the node and a replay make the same of one recording in which time jumps back."""

import itertools
import json

import pytest
from recordings import RESULTS, TOPICS, write_mcap

from graph_slam_ros.cli import main
from graph_slam_ros.measurements.types import Odometry
from graph_slam_ros.recordings.bag import BagMessage, open_bag
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Counters
from graph_slam_ros.slam.frontend.ingest_gate import IngestGate
from graph_slam_ros.tools.simulation import simulate, write_bag

S = 10**9


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A drive whose stamps begin again after 12 s: what is received goes on."""
    folder = tmp_path_factory.mktemp("recording")
    write_bag(simulate("warehouse", 5, aisles=2, laps=1, aisle_m=4.0), folder / "drive.mcap")
    drive = list(open_bag(folder / "drive.mcap").messages(TOPICS))
    first = [m for m in drive if m.log_ns - drive[0].log_ns < 12 * S]
    shift_ns = first[-1].log_ns - drive[0].log_ns + S
    again = [BagMessage(m.topic, m.log_ns + shift_ns, m.cdr) for m in first]
    return write_mcap(folder / "jump.mcap", [*first, *again])


def results(folder):
    return {name: (folder / name).read_bytes() for name in RESULTS}


def driven_live(recording, folder, on_jump):
    """The same messages, handed to a node as its subscriptions do."""
    rclpy_context = pytest.importorskip("rclpy.context")
    from live_nodes import own_domain
    from rclpy.parameter import Parameter

    from graph_slam_ros.node.node import GraphSlamNode

    values = {"output.folder": str(folder), "time.on_jump": on_jump, "use_sim_time": True, "inputs.queue": 100_000}
    context = rclpy_context.Context()
    with own_domain() as domain:
        context.init(args=[], domain_id=int(domain))
        given = [Parameter(name, value=value) for name, value in values.items()]
        node = GraphSlamNode(context=context, parameter_overrides=given)
        try:
            node.trigger_configure()
            for message in open_bag(recording).messages(TOPICS):
                name = "odom" if message.topic == "/odom" else "detections"
                node._run.ingest.receive(node._run.ingest.converter.convert(name, message.cdr))
            node.finish()
        finally:
            node.destroy_node()
            context.try_shutdown()


@pytest.mark.parametrize(("on_jump", "runs"), [("segment", ["run"]), ("reset", ["run-2", "run"]), ("stop", ["run"])])
def test_B7_of_one_recording_with_a_jump_a_replay_makes_what_the_node_makes_and_says_so(
    tmp_path, monkeypatch, recording, capsys, on_jump, runs
):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    live, again = tmp_path / "live", tmp_path / "replayed"
    for folder in (live, again):
        if on_jump == "reset":
            (folder / "run-1").mkdir(parents=True)
            (folder / "run-1" / "of_a_person").touch()
    code = main(["replay", str(recording), "--out", str(again / "run"), "--set", f"time.on_jump={on_jump}"])
    said = capsys.readouterr()
    driven_live(recording, live / "run", on_jump)
    assert sorted(p.name for p in again.iterdir()) == sorted(p.name for p in live.iterdir())
    assert sorted(p.parent.name for p in live.glob("*/run.json")) == sorted(runs)
    for run in runs:
        assert results(again / run) == results(live / run)
        replay(again / run, tmp_path / "repeated", force=True)
        assert results(tmp_path / "repeated") == results(again / run), "its own journal gives it again"
    told = [json.loads((again / run / "run.json").read_text()) for run in runs]
    odom = [one["inputs"]["odom"] for one in told]
    assert [one["segments"] for one in told] == ([2] if on_jump == "segment" else [1] * len(runs))
    assert sum(one["received"] for one in odom) == open_bag(recording).topics["/odom"].count
    if on_jump == "reset":
        assert code == 0
        assert f"time.on_jump is reset: the run until then is in {again / 'run-2'}" in said.out
        assert (again / "run-1" / "of_a_person").exists()
        assert odom[1]["received"] == odom[1]["used"], "each message is of one run"
    refused = {name: of["stopped"] for name, of in told[0]["counters"].items() if "stopped" in of}
    assert bool(refused) == (on_jump == "stop") and code >= 3 * bool(refused)
    if refused:
        assert refused["odom"] > 500
        assert f"time.on_jump is stop: {sum(refused.values())} measurements after it were refused" in said.err
        assert "--set time.on_jump=segment" in said.err


def odometry(seconds, name="odom"):
    return [Odometry(1000 * S + round(seconds * S), (0.0, 0.0, 0.0), None, name)]


def test_B7_what_was_on_its_way_when_the_clock_jumped_is_known_until_the_clock_is_there():
    clock = itertools.chain([1010 * S], itertools.repeat(1020 * S, 2), itertools.repeat(1100 * S))
    gate = IngestGate(Counters(), lambda: next(clock))
    assert not gate.is_from_before(odometry(60.0)), "it did not jump"
    gate.clock_jumped(-60 * S)
    assert gate.is_from_before(odometry(60.0))
    assert not gate.is_from_before(odometry(15.0))
    assert not gate.is_from_before(odometry(60.0)), "the clock is there"

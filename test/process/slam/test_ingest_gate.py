"""The gate in front of the pipeline: the node and a replay make the same of one recording in which time jumps back."""

import itertools
import json

import pytest
from recordings import RESULTS, TOPICS, write_mcap

from graph_slam_ros.cli import main
from graph_slam_ros.measurements.types import Odometry
from graph_slam_ros.recordings.bag import BagMessage, open_bag
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config, Control, Counters
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


def config(on_jump):
    return Config.from_mapping({"time.on_jump": on_jump})


def results(folder):
    return {name: (folder / name).read_bytes() for name in RESULTS}


def summary(folder):
    return json.loads((folder / "run.json").read_text())


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
                node._run._ingest.receive(node._run._ingest.converter.convert(name, message.cdr), message.cdr)
            node.finish()
        finally:
            node.destroy_node()
            context.try_shutdown()


@pytest.mark.parametrize(("on_jump", "runs"), [("segment", ["run"]), ("reset", ["run-1", "run"]), ("stop", ["run"])])
def test_B7_of_one_recording_with_a_jump_a_replay_makes_what_the_node_makes(
    tmp_path, monkeypatch, recording, on_jump, runs
):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    live, again = tmp_path / "live", tmp_path / "replayed"
    live.mkdir()
    done = replay(recording, again / "run", config(on_jump))
    driven_live(recording, live / "run", on_jump)
    assert sorted(p.name for p in again.iterdir()) == sorted(p.name for p in live.iterdir()) == sorted(runs)
    for run in runs:
        assert results(again / run) == results(live / run)
        replay(again / run, tmp_path / "repeated", force=True)
        assert results(tmp_path / "repeated") == results(again / run), "its own journal gives it again"
    assert [one.folder.name for one in done.earlier] == runs[:-1]
    segments = [summary(again / run)["segments"] for run in runs]
    assert segments == ([2] if on_jump == "segment" else [1] * len(runs))


def test_B7_where_a_replay_stops_at_a_jump_what_comes_after_is_counted_and_said_and_the_exit_code_tells(
    tmp_path, recording, capsys
):
    assert main(["replay", str(recording), "--out", str(tmp_path / "run"), "--set", "time.on_jump=stop"]) == 3
    counters, inputs = summary(tmp_path / "run")["counters"], summary(tmp_path / "run")["inputs"]
    refused = {name: of["stopped"] for name, of in counters.items()}
    assert refused["odom"] > 500
    assert inputs["odom"]["received"] == inputs["odom"]["used"] + sum(counters["odom"].values())
    said = capsys.readouterr().err
    assert f"time.on_jump is stop: {sum(refused.values())} measurements after it were refused" in said
    assert "--set time.on_jump=segment" in said


def test_B7_where_a_replay_begins_another_run_it_says_where_the_one_before_is_and_removes_none(
    tmp_path, recording, capsys
):
    (tmp_path / "run-1").mkdir()
    (tmp_path / "run-1" / "of_a_person").touch()
    assert main(["replay", str(recording), "--out", str(tmp_path / "run"), "--set", "time.on_jump=reset"]) == 0
    assert f"time.on_jump is reset: the run until then is in {tmp_path / 'run-2'}" in capsys.readouterr().out
    assert (tmp_path / "run-1" / "of_a_person").exists()
    earlier, later = (summary(tmp_path / name) for name in ("run-2", "run"))
    whole = open_bag(recording).topics["/odom"].count
    assert earlier["inputs"]["odom"]["received"] + later["inputs"]["odom"]["received"] == whole
    assert later["inputs"]["odom"]["received"] == later["inputs"]["odom"]["used"], "each message is of one run"
    assert earlier["span_s"] == pytest.approx(later["span_s"], abs=2.0)


# -- the gate alone ----------------------------------------------------------------------------------------------------


def odometry(seconds, name="odom"):
    return [Odometry(1000 * S + round(seconds * S), (0.0, 0.0, 0.0), None, name)]


@pytest.fixture
def counters():
    return Counters()


@pytest.fixture
def gate(counters):
    return IngestGate(counters)


def jump_back(gate, on_jump):
    """Fifty seconds there and back: what the gate made of the message that showed it, the 11th after it."""
    for k in range(500):
        assert gate.admit(odometry(0.1 * k), on_jump).measured
    passages = [gate.admit(odometry(0.1 * k), on_jump) for k in range(11)]
    assert not any(p.jump for p in passages[:-1])
    return passages[-1]


def test_B7_after_a_jump_a_segment_begins_and_its_measurements_pass(gate, counters):
    passage = jump_back(gate, "segment")
    assert (passage.jump, passage.events, len(passage.measured)) == ("segment", (Control("time_jump"),), 1)
    assert counters.as_dict() == {}


def test_B7_after_a_jump_that_stops_nothing_passes_until_another_run_begins(gate, counters):
    assert jump_back(gate, "stop").measured == ()
    assert gate.admit(odometry(2.0), "segment").measured == (), "whatever is asked for meanwhile"
    assert counters.as_dict() == {"odom": {"stopped": 2}}
    gate.begin_run()
    assert gate.admit(odometry(3.0), "stop").measured


def test_P10_what_is_paused_or_finds_no_room_is_refused_by_its_reason_and_input(gate, counters):
    assert not gate.admit(odometry(0.0, "odom#2"), "segment", has_room=False).measured
    gate.is_paused = True
    assert not gate.admit(odometry(1.0), "segment", has_room=False).measured
    gate.is_paused = False
    assert gate.admit(odometry(2.0), "segment").measured
    assert counters.as_dict() == {"odom": {"overflow": 1, "paused": 1}}


def test_B7_what_was_on_its_way_when_the_clock_jumped_is_known_until_the_clock_is_there(counters):
    clock = itertools.chain([1010 * S], itertools.repeat(1020 * S, 2), itertools.repeat(1100 * S))
    gate = IngestGate(counters, lambda: next(clock))
    assert not gate.is_from_before(odometry(60.0)), "it did not jump"
    gate.clock_jumped(-60 * S)
    assert gate.is_from_before(odometry(60.0))
    assert not gate.is_from_before(odometry(15.0))
    assert not gate.is_from_before(odometry(60.0)), "the clock is there"

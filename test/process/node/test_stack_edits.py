"""The map of a running node: held while the robot is located in it, edited by hand, saved by name and loaded."""

from geometry_msgs.msg import PoseWithCovarianceStamped
from live_drive import Drive, distance
from live_nodes import finish, node, numbers, replayed, results, robot, until
from std_msgs.msg import String


def places(message):
    return {one.id: one.results[0].pose.pose.position for one in message.detections}


def test_the_map_is_held_and_edited_while_the_node_runs_and_a_robot_that_was_carried_is_found(tmp_path):
    hears = "pose", "path", "landmarks_estimate", "/diagnostics", "events"
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n, robot(hears=hears) as r:
        remove = r.publisher("/graph_slam/remove", String)
        given = r.publisher("initialpose", PoseWithCovarianceStamped)
        r.wait_for_node()
        drive = Drive()
        until(lambda: r.heard["landmarks_estimate"] and r.heard["pose"], drive.pace(r), "landmarks")
        drive.go(r, 60, every=2)
        r.settle()
        assert r.set({"map.localize": True, "output.path_max_poses": 20}) == (True, "")
        drive.go(r, 10, every=2)
        r.settle()
        held = places(r.heard["landmarks_estimate"][-1])
        drive.go(r, 40, every=2)
        r.settle()
        assert held and places(r.heard["landmarks_estimate"][-1]) == held
        assert 10 <= len(r.heard["path"][-1].poses) <= 20, "thinned"
        assert drive.off_by(r) < 1.0
        assert r.set({"map.localize": False}) == (True, "")
        wrong = PoseWithCovarianceStamped()
        wrong.header.frame_id, wrong.pose.pose.orientation.w = "odom", 1.0
        for _ in range(2):
            remove.publish(String(data="landmark nobody"))
            given.publish(wrong)
        for what in ("landmark nort", "everything, please", f"landmark {min(held)}"):
            remove.publish(String(data=what))
        gone = lambda: min(held) not in places(r.heard["landmarks_estimate"][-1])  # noqa: E731
        until(gone, r.spin, "the landmark to be removed")
        until(lambda: r.said("asked"), r.spin, "answer on /diagnostics")

        r.until_it_says("OK", spin=drive.pace(r))
        drive.truth = drive.truth[0] + 30.0, drive.truth[1] - 2.0, drive.truth[2] + 1.0
        slowly = lambda seconds: (drive.step(r), r.spin(0.1))  # noqa: E731, longer than diagnostics are apart
        r.until_it_says("DEGRADED", "elsewhere", spin=slowly)
        r.until_it_says("OK", spin=drive.pace(r))
        until(lambda: drive.off_by(r) < 0.5, drive.pace(r), "the pose that the landmarks show")
        r.until_graph(drive.pace(r), segments=2)
        finish(n, r)
    events = [s for m in r.heard["events"] for s in m.status]
    assert any(s.name == "graph_slam: displaced" and "segment" in {v.key for v in s.values} for s in events)
    asked = [s.message for s in events if s.name == "graph_slam: asked"]
    assert f"~/remove: landmark {min(held)}: done" in asked
    assert sum(one.startswith("initialpose: not used: ") for one in asked) == 2
    assert any(one.startswith("~/remove: landmark nort: ") and "did you mean 'north'?" in one for one in asked)
    assert "neither 'edge ID' nor 'landmark NAME'" in n.said
    why = "~/remove named an unknown landmark (unknown_landmark): ros2 topic echo"
    assert n.said.count(f"~/remove: landmark nobody: {why}") == 2, "each time"
    assert f"~/remove: landmark {min(held)}" not in n.said
    assert n.said.count("initialpose: not used: ") == 2, "each time"
    assert numbers(tmp_path / "run")["counters"]["edit"] == {"removed": 1, "unknown_landmark": 3}
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")


def text(pose):
    return " ".join(f"{number:.3f}" for number in pose)


def located(r, drive):
    """Nothing was seen: pose and transform are there with the first odometry, and the pose is the given one."""
    at = drive.truth
    r.heard["pose"].clear()
    r.heard["tf"].clear()
    until(lambda: r.heard["pose"] and r.heard["tf"], drive.pace(r), "place in the map")
    said = r.heard["pose"][0].pose.pose.position
    assert distance((said.x, said.y), at) < 0.01


def test_a_map_is_saved_by_name_and_loaded_by_a_call_or_at_the_start_with_the_pose_of_the_robot(tmp_path):
    given, hears = (f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true"), ("pose", "/tf", "/diagnostics")
    with node(*given) as n, robot(hears=hears) as r:
        r.wait_for_node()
        drive = Drive()
        drive.go(r, 60, every=3)
        r.settle()
        for name, why in (
            ("run-3", "run is saved; run-3: earlier runs are called so"),
            ("site", ""),
            ("site", "run is saved; site: is there already"),
        ):
            assert r.set({"output.save_as": name}) == (True, "")
            answer = r.save()
            assert answer.success == (not why) and why in answer.message
        landmarks = [(tmp_path / name / "landmarks.csv").read_text().count("\n") for name in ("site", "run")]
        assert landmarks[0] == landmarks[1] > 3
        drive.sees = False
        drive.stamp_ns += 10**9
        assert r.set({"output.load": "site", "output.load_pose": text(drive.truth)}) == (True, "")
        answer = r.call("load")
        assert answer.success and "the robot is taken to be at" in answer.message
        r.settle()  # the end of the run before has poses, too
        located(r, drive)
        finish(n, r)
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")
    assert not (tmp_path / "run-3").exists()
    drive = Drive(truth=(2.0, 1.0, 0.5))
    at_start = "output.load:=site", "output.load_at_start:=true", f"output.load_pose:='{text(drive.truth)}'"
    with node(*given, *at_start) as n, robot(hears=hears) as r:
        r.wait_for_node()
        drive.sees = False
        located(r, drive)
        assert n.stop()[0] == 0

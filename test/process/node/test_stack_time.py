"""The node with a clock of its own: played, paused, jumping, played again and again."""

import itertools

from live_drive import TAGS, Drive
from live_nodes import finish, node, numbers, often, replayed, results, robot, until
from rosgraph_msgs.msg import Clock

NS = 10**9
HEARS = "/diagnostics", "/tf", "pose"


class Played:
    """A drive with /clock."""

    def __init__(self, r, start_s=5_000, **options):
        self.robot, self.drive = r, Drive(start_s * NS, **options)
        self._clock = r.publisher("/clock", Clock)
        until(self._clock.get_subscription_count, r.spin, "subscriber of /clock")

    def tell(self, stamp_ns=None):
        """The time."""
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(self.drive.stamp_ns if stamp_ns is None else stamp_ns, NS)
        self._clock.publish(message)

    def step(self, seconds=0.02):
        if not self.robot.is_ahead:
            self.tell()
            self.drive.step(self.robot)
        self.robot.spin(seconds)


def stamps(r):
    """Of the transforms heard."""
    return [t.header.stamp.sec * NS + t.header.stamp.nanosec for m in r.heard["tf"] for t in m.transforms]


def is_ascending(numbers):
    return all(b > a for a, b in itertools.pairwise(numbers))


def parameters(folder):
    return f"output.folder:={folder}", "inputs.reliable:=true"


def test_B7_B8_B11_B12_B13_B14_of_a_simulated_clock_jumps_alone_begin_segments_of_one_map(tmp_path):
    loops = often(1)
    with node(*parameters(tmp_path / "run"), "use_sim_time:=true") as n, robot(hears=HEARS) as r:
        r.wait_for_node()
        played = Played(r)
        r.until_it_says("WAITING", "use_sim_time is set and nothing comes on /clock")
        until(lambda: r.heard["pose"], lambda s: (played.drive.step(r), r.spin(s)), "pose before there is a clock")
        r.until_it_says("DEGRADED", "nothing comes on /clock")
        r.until_it_says("OK", spin=played.step)
        for k in range(15):
            if k % 3 == 0:
                played.tell(played.drive.stamp_ns - NS // 8)  # back a little
            played.step(0.01)
        r.until_it_says("OK", spin=played.step)
        r.settle()
        r.heard["diagnostics"].clear()
        until(lambda: len(r.said()) > 3, r.spin, "diagnostics while the clock is paused")
        assert {values["state"] for _, values in r.said()} == {"OK"}, "nothing is silent"
        assert r.save().success and r.call("optimize").success
        r.until_graph(played.step, segments=1)
        assert "jumped" not in n.said

        late, before = played.drive.odometry(), stamps(r)
        played.drive.stamp_ns -= 60 * NS
        begin_ns = played.drive.stamp_ns
        r.heard["tf"].clear()
        for _ in range(3):
            played.tell()
            r.spin(0.1)
            r.send("/odom", late)  # of before the jump, and holds nothing up
            played.step()
        r.heard["pose"].clear()
        until(lambda: len(r.heard["pose"]) > 10 and len(stamps(r)) > 10, played.step, "what follows the jump")
        assert played.drive.off_by(r) < 1.0, "still in the same map"
        assert is_ascending(before)
        assert is_ascending(after := stamps(r))
        assert begin_ns <= after[0] < begin_ns + 2 * NS
        assert max(after) < played.drive.stamp_ns + NS
        r.until_it_says("OK", spin=played.step)

        for _ in range(loops):  # a recording that is played again and again
            played.drive = Drive(4_000 * NS)
            played.tell()
            r.spin(0.1)
            until(lambda: played.drive.steps >= 50, played.step, "end of the recording")
            r.until_it_says("OK")
        r.settle()
        r.until_graph(segments=2 + loops)
        assert played.drive.off_by(r) < 1.0
        finish(n, r)
    told = numbers(tmp_path / "run")
    assert (told["segments"], told["landmarks"]) == (2 + loops, len(TAGS))
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")

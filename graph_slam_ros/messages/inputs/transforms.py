"""Transforms between frames: the mounts of sensors, fixed or on moving joints."""

from bisect import bisect_left
from collections.abc import Callable
from operator import itemgetter

from graph_slam_ros.lie import se3
from graph_slam_ros.messages.inputs.stamp_leap import StampLeap

MAP_FRAMES = ("map", "earth", "utm")
"""Frames of maps: odometry in one of them is the output of a localiser. Visual odometry calls its own frame "world"."""
OPTICAL = "0 0 0 -1.5707963 0 -1.5707963"
"""x y z roll pitch yaw of a camera's optical frame at the base, looking ahead: z ahead, x to the right."""


def assumed_mount(frame: str) -> str:
    """The pose on the robot of a sensor that TF does not have: at the base, and of an optical frame looking ahead."""
    return OPTICAL if "optical" in frame else "0 0 0 0 0 0"


class Transforms:
    """The transforms of /tf_static and /tf so far.

    Parameters
    ----------
    keep_ns : how much older than its newest a transform of /tf may get; as of tf2
    refuse : called once for each of /tf that is dated farther than that from the others of its frame, and from odometry

    Attributes
    ----------
    now_ns : the newest stamp of odometry, None before the first: what may still come is judged by it
    links : how often a frame got a parent, or another one
    """

    def __init__(self, keep_ns: int = 10_000_000_000, refuse: Callable[[], None] = lambda: None) -> None:
        self._keep_ns, self._refuse = keep_ns, refuse
        self._fixed: dict[str, tuple[str, se3.Pose]] = {}
        self._moving: dict[str, _Joint] = {}
        self.now_ns: int | None = None
        self.links = 0

    def add(self, parent: str, child: str, T_parent_child: se3.Pose) -> None:
        """Add a static transform. A later one for the same child replaces it."""
        self.links += 1
        self._fixed[child] = (parent, T_parent_child)

    def add_at(self, stamp_ns: int, parent: str, child: str, T_parent_child: se3.Pose) -> None:
        """Add a transform at its stamp."""
        joint = self._moving.get(child)
        if joint is None or joint.parent != parent:
            self.links += 1
            joint = self._moving[child] = _Joint(parent, self._keep_ns, self._refuse)
        joint.add(stamp_ns, T_parent_child, self.now_ns)

    def forget_time(self) -> None:
        """Begin anew with the stamps. Static transforms stay."""
        self._moving.clear()
        self.now_ns = None

    def knows(self, frame: str) -> bool:
        """Return whether the frame has a parent."""
        return frame in self._fixed or frame in self._moving

    def are_linked(self, a: str, b: str) -> bool:
        """Return whether two frames are in one tree, whatever the stamps."""
        return self._root(a) == self._root(b)

    def _root(self, frame: str) -> str:
        seen = {frame}
        while frame in self._fixed or frame in self._moving:
            frame = self._fixed[frame][0] if frame in self._fixed else self._moving[frame].parent
            if frame in seen:  # a loop
                break
            seen.add(frame)
        return frame

    def lookup(self, target: str, source: str, stamp_ns: int | None = None) -> se3.Pose | None:
        """``T_target_source`` at a stamp, or of static transforms only; None if the frames are not linked then."""
        if target == source:
            return se3.IDENTITY
        to_root_target, to_root_source = self._to_root(target, stamp_ns), self._to_root(source, stamp_ns)
        for frame, T_frame_source in to_root_source.items():
            if frame in to_root_target:
                return se3.compose(se3.inverse(to_root_target[frame]), T_frame_source)
        return None

    def _to_root(self, frame: str, stamp_ns: int | None) -> dict[str, se3.Pose]:
        """``T_ancestor_frame`` of the frame itself and each ancestor, nearest first."""
        out: dict[str, se3.Pose] = {frame: se3.IDENTITY}
        at, T_at_frame = frame, se3.IDENTITY
        while (link := self._link(at, stamp_ns)) is not None:
            at, T_parent_at = link
            if at in out:  # a loop
                break
            T_at_frame = se3.compose(T_parent_at, T_at_frame)
            out[at] = T_at_frame
        return out

    def _link(self, child: str, stamp_ns: int | None) -> tuple[str, se3.Pose] | None:
        if child in self._fixed:
            return self._fixed[child]
        joint = self._moving.get(child)
        T = None if joint is None or stamp_ns is None else joint.at(stamp_ns)
        return None if joint is None or T is None else (joint.parent, T)


class _Joint:
    """The recent motion of one frame in its parent."""

    def __init__(self, parent: str, keep_ns: int, refuse: Callable[[], None]) -> None:
        self.parent, self._keep_ns = parent, keep_ns
        self._leap = StampLeap[se3.Pose](refuse)
        self._poses: list[tuple[int, se3.Pose]] = []  # by ascending stamp

    def add(self, stamp_ns: int, T_parent_child: se3.Pose, now_ns: int | None) -> None:
        newest_ns = self._poses[-1][0] if self._poses else stamp_ns
        if now_ns is not None and abs(stamp_ns - now_ns) < abs(stamp_ns - newest_ns):
            newest_ns = now_ns  # seen again after a while, such as the frame of a tag: no leap
        for one in self._leap.accept(stamp_ns, T_parent_child, newest_ns, self._keep_ns):
            if self._poses and one[0] < self._poses[-1][0] - self._keep_ns:  # several agree that it is so early
                self._poses.clear()
            at = self._place(one[0])
            is_again = at < len(self._poses) and self._poses[at][0] == one[0]
            self._poses[at : at + is_again] = [one]
            del self._poses[: self._place(self._poses[-1][0] - self._keep_ns)]

    def at(self, stamp_ns: int) -> se3.Pose | None:
        """Interpolated pose; None before the first and after the last, because nothing is extrapolated."""
        after = self._place(stamp_ns)
        if after < len(self._poses) and self._poses[after][0] == stamp_ns:
            return self._poses[after][1]
        if not 0 < after < len(self._poses):
            return None
        (start, a), (end, b) = self._poses[after - 1 : after + 1]
        return se3.interpolate(a, b, (stamp_ns - start) / (end - start))

    def _place(self, stamp_ns: int) -> int:
        return bisect_left(self._poses, stamp_ns, key=itemgetter(0))

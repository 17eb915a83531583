"""Updates of the path, for subscribers that cannot take the whole path each time.

A message has the keyframes that are new or have moved. Each pose is identified by its stamp: it replaces the pose with
this stamp, or is inserted between its neighbours. A message without poses means: forget all, the whole path follows.
Keyframes that were condensed are not sent again.

Messages are numbered, as those of interactive markers are (``seq_num``). nav_msgs/Path has no field for the number, so
``/diagnostics`` publishes the count. A subscriber that received fewer messages since the path began lacks some poses.
"""

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.messages import to_msg
from graph_slam_ros.slam import MapView
from graph_slam_ros.typing import Array


class PathUpdates:
    """Remembers what was sent of one path. A comparison finds what has moved: 20,000 poses take under 1 ms.

    Parameters
    ----------
    moved_m, moved_rad : a keyframe that has moved and turned by no more than this since it was sent is not sent again

    Attributes
    ----------
    version : how many messages there were since the path began anew, that which said so included
    """

    def __init__(self, moved_m: float, moved_rad: float) -> None:
        self.version = 0
        self._moved_m, self._moved_rad = moved_m, moved_rad
        self._sent: Array = np.empty((0, 0))
        self._first = 0  # the number of the first keyframe of these

    def restart(self, view: MapView) -> bytes:
        """nav_msgs/Path without poses: forget all; the next update contains every keyframe.

        It is due for a new subscriber, and after another ``GraphSlam`` has begun.
        """
        self.version = 1
        self._sent, self._first = np.empty((0, 0)), view.keyframes.first
        return to_msg.path(view.config.frames.map, [], self._sent)

    def update(self, view: MapView) -> bytes | None:
        """nav_msgs/Path of the keyframes that are new or have moved, in order of time, with the newest stamp of all.

        None if there are none.
        """
        now, old = view.trajectory(), self._sent[view.keyframes.first - self._first :]
        changed = np.ones(len(now), dtype=bool)
        if len(old):
            changed[: len(old)] = self._moved(view.space.dimensions, old, now[: len(old)])
        which = np.flatnonzero(changed)
        self._sent, self._first = old, view.keyframes.first
        if not len(which):
            return None
        self._sent = np.concatenate((old.reshape(-1, now.shape[1]), now[len(old) :]))
        self._sent[which] = now[which]
        self.version += 1
        newest_ns = int(view.keyframes.stamps_ns[-1])
        return to_msg.path(view.config.frames.map, view.keyframes.stamps_ns[which], now[which], newest_ns)

    def _moved(self, n: int, old: Array, now: Array) -> NDArray[np.bool_]:
        """Return whether poses have moved or turned too far; n is the number of coordinates of a position."""
        step = now - old
        far = np.einsum("ij,ij->i", step[:, :n], step[:, :n]) > self._moved_m**2
        if n == 2:
            turn = step[:, 2] - 2.0 * np.pi * np.round(step[:, 2] / (2.0 * np.pi))
            return far | (np.abs(turn) > self._moved_rad)
        # the chord between two unit quaternions, of which one is as good as its negative, is 2 sin(angle / 4)
        sign = np.where(np.einsum("ij,ij->i", old[:, 3:], now[:, 3:]) < 0.0, -1.0, 1.0)
        chord = now[:, 3:] - sign[:, None] * old[:, 3:]
        most = 2.0 * np.sin(0.25 * min(self._moved_rad, np.pi))
        return far | (np.einsum("ij,ij->i", chord, chord) > most**2)

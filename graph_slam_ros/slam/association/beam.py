"""A beam of hypotheses: joint Gaussians of the pose, odometry's scales and the landmarks.

A hypothesis says which landmark each cluster is, and where odometry slipped. Each new cluster makes several hypotheses
of each one: for every landmark that fits, for a new landmark, and for a false sighting. They are updated one after
another with the joint covariance, so that the assignments are jointly compatible (Neira and Tardos, 2001). The
likeliest are kept. Of hypotheses with the same recent decisions only the best is kept. The first one is the leader.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.slam.association.scans import Cluster, Motion, Scan, are_others
from graph_slam_ros.slam.landmarks.rotations import lever, rotation
from graph_slam_ros.typing import Array

NOTHING = -2
"""What a cluster is that is of no landmark."""
_FREE, _SLIPPED = -1, -9
_UNLIKELY = 2.0  # log of how much less likely nothing is than something new
_SLIP_LONGEST = 6.0  # times the interval of slips: a longer gap makes none likelier
_MORE_SLOTS = 8  # landmarks by which a hypothesis grows at once
_REVISED = 500  # the newest clusters, whose landmarks may change

Ids = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class BeamSettings:
    """Settings of the beam.

    Attributes
    ----------
    gate : chi2 up to which a cluster may be of a landmark
    log_new : log density of new landmarks
    hypotheses : how many are kept
    within : log weight below the best at which one is dropped
    alike : decisions after which two that agree are one
    slots : landmarks that a hypothesis holds at once; the one not seen for longest leaves
    scale_sigma : of odometry's two scales
    clock_sigma_s : of the clock of each input, against odometry's
    slip_every_s, slip_log_prior, slip_sigma_m, slip_sigma_rad : how odometry slips
    """

    gate: float
    log_new: float
    hypotheses: int = 40
    within: float = 20.0
    alike: int = 14
    slots: int = 40
    scale_sigma: float = 0.1
    clock_sigma_s: float = 0.5
    slip_every_s: float = 2.0
    slip_log_prior: float = -3.5
    slip_sigma_m: float = 0.15
    slip_sigma_rad: float = 0.3


@dataclass(frozen=True, slots=True)
class _Expected:
    log_likelihood: Array  # (K, L)
    residual: Array  # (K, L, n)
    inverse: Array  # (K, L, n, n)
    of_turn: Array  # (K, L, n, r)
    back: Array  # (K, n, n)


class Beam:
    """The hypotheses, the best first.

    Attributes
    ----------
    log_weight : (K,) relative to the best
    position, turn, scales : (K, n), (K, n, n), (K, 2)
    landmarks, ids : (K, L, n), (K, L); the number of a landmark, or -1 where the slot is free
    sorts : (K, L) class of a landmark; empty where it has none
    covariance : (K, D, D) of position, rotation in the robot's frame, scales, landmarks
    last : (K, L) the scan in which a landmark was seen last
    decided : (K, C) the landmarks of the newest clusters
    """

    def __init__(
        self,
        settings: BeamSettings,
        position: Array,
        turn: Array,
        scales: Array,
        landmarks: Mapping[int, tuple[Array, str]],
        covariance: Array,
    ) -> None:
        """Begin with one hypothesis.

        Parameters
        ----------
        position, turn, scales : (n,), (n, n), (2,)
        landmarks : place (n,) and class, by number
        covariance : (D, D)
        """
        self.settings = settings
        self._n = n = len(position)
        self._r = 1 if n == 2 else 3
        self._base = n + self._r + 2
        slots = len(landmarks)
        self.position, self.turn, self.scales = position[None].copy(), turn[None].copy(), scales[None].copy()
        self.landmarks = np.array([place for place, _ in landmarks.values()]).reshape(1, slots, n)
        self.sorts = np.array([sort for _, sort in landmarks.values()], dtype=object).reshape(1, slots)
        self.ids, self.last = np.array([list(landmarks)], dtype=np.int64), np.zeros((1, slots), dtype=np.int64)
        self.covariance = covariance[None].copy()
        self.log_weight = np.zeros(1)
        self.decided = np.empty((1, 0), dtype=np.int64)
        self._clusters: list[int] = []  # of its columns
        self._signs: list[tuple[int, ...]] = [()]
        self._scans, self._since_slip = 0, 0.0

    # -- a scan ------------------------------------------------------------------------------------------------------

    def advance(self, motion: Motion) -> None:
        """Move all hypotheses to the next scan. At intervals each one also branches into a slip of odometry."""
        self._predict(motion)
        self._since_slip += motion.moving_s
        if self._since_slip >= self.settings.slip_every_s and not motion.is_broken:
            self._slip(self._since_slip)
            self._since_slip = 0.0

    def explain(self, scan: Scan, first: int) -> dict[int, int]:
        """Explain a scan. Returns the landmarks of its clusters by the leader, and of others where they have changed.

        Parameters
        ----------
        first : number of its first cluster; the others follow
        """
        self._scans += 1
        before, count = self._leader(), len(self._clusters)
        order = sorted(range(len(scan.clusters)), key=lambda k: float(np.linalg.norm(scan.clusters[k].point)))
        for k in order:
            self._explain_cluster(scan.clusters[k], first + k, self.decided[:, count:])
        self._keep(np.argsort(-self.log_weight, kind="stable")[: self.settings.hypotheses])
        self.log_weight -= self.log_weight[0]
        self.covariance = 0.5 * (self.covariance + self.covariance.transpose(0, 2, 1))
        changed = {c: landmark for c, landmark in sorted(self._leader().items()) if before.get(c) != landmark}
        self.decided, self._clusters = self.decided[:, -_REVISED:], self._clusters[-_REVISED:]
        return changed

    def _leader(self) -> dict[int, int]:
        return dict(zip(self._clusters, self.decided[0].tolist(), strict=True))

    def _keep(self, which: Ids) -> None:
        of_each = "position turn scales landmarks ids sorts last covariance log_weight decided"
        for name in of_each.split():
            setattr(self, name, getattr(self, name)[which])
        self._signs = [self._signs[i] for i in which.tolist()]

    def _predict(self, m: Motion) -> None:
        n, r, b = self._n, self._r, self._base
        turn, (by_way, by_turn) = self.turn, self.scales.T
        turned = m.turn * (1.0 + by_turn[:, None])
        local = rotation(0.5 * m.turn * by_turn[:, None]) @ m.way  # the arc is turned by half of what the scale adds
        stretched = local * (1.0 + by_way[:, None])
        f = np.broadcast_to(np.eye(b), (len(turn), b, b)).copy()
        f[:, :n, n : n + r] = turn @ lever(stretched)
        f[:, :n, n + r] = (turn @ local[..., None])[..., 0]
        f[:, :n, n + r + 1] = 0.5 * (f[:, :n, n : n + r] @ m.turn)
        if r == 3:
            f[:, n : n + r, n : n + r] = rotation(-turned)
        f[:, n : n + r, n + r + 1] = m.turn
        self.position = self.position + (turn @ stretched[..., None])[..., 0]
        self.turn = turn @ rotation(turned)
        p = self.covariance
        p[:, :b, :] = f @ p[:, :b, :]
        p[:, :, :b] = p[:, :, :b] @ f.transpose(0, 2, 1)
        g = np.broadcast_to(np.eye(n + r), (len(turn), n + r, n + r)).copy()
        g[:, :n, :n] = turn
        p[:, : n + r, : n + r] += g @ m.covariance @ g.transpose(0, 2, 1)

    def _slip(self, since_s: float) -> None:
        """Copy each hypothesis, with a slip of odometry in this stretch."""
        c, count, n, r = self.settings, len(self.log_weight), self._n, self._r
        self._keep(np.tile(np.arange(count), 2))
        part = min(max(since_s / c.slip_every_s, 1.0), _SLIP_LONGEST)
        self.log_weight[count:] += c.slip_log_prior + np.log(part)
        at = np.arange(n + r)
        self.covariance[count:, at, at] += part * np.square([c.slip_sigma_m] * n + [c.slip_sigma_rad] * r)
        self._signs[count:] = [(*sign, _SLIPPED)[-c.alike :] for sign in self._signs[count:]]

    # -- a cluster ---------------------------------------------------------------------------------------------------

    def _explain_cluster(self, cluster: Cluster, number: int, used: Ids) -> None:
        """Branch over the landmarks of a cluster, but for those (K, m) that each hypothesis has used in this scan."""
        c, slots = self.settings, self.ids.shape[1]
        what = self._expect(cluster)
        fits = what.log_likelihood
        fits[(self.ids[:, :, None] == used[:, None]).any(axis=2)] = -np.inf
        others = np.broadcast_to([c.log_new, c.log_new - _UNLIKELY], (len(fits), 2))
        weights = (np.concatenate([fits, others], axis=1) + self.log_weight[:, None]).ravel()
        likely = np.flatnonzero(weights > weights.max() - c.within)
        kept = list[tuple[int, int, int]]()
        signs: dict[tuple[int, ...], float] = {}
        for at in likely[np.argsort(-weights[likely], kind="stable")].tolist():
            i, option = divmod(at, slots + 2)
            name = int(self.ids[i, option]) if option < slots else (number if option == slots else NOTHING)
            sign = (*self._signs[i], name)[-c.alike :]
            if sign not in signs:
                signs[sign] = float(weights[at])
                kept.append((i, option, name))
                if len(kept) == c.hypotheses:
                    break
        source, options, names = np.array(kept).T
        self._keep(source)
        self.log_weight, self._signs = np.array(list(signs.values())), list(signs)
        self.decided = np.column_stack([self.decided, names])
        self._clusters.append(number)
        self._update(source, options, what)
        self._begin(np.flatnonzero(options == slots), cluster, number)

    def _expect(self, cluster: Cluster) -> _Expected:
        """Predict all landmarks in all hypotheses: the likelihood of the cluster, and the terms of an update."""
        n, r, b = self._n, self._r, self._base
        count, slots = self.ids.shape
        back = self.turn.transpose(0, 2, 1)
        seen = (back[:, None] @ (self.landmarks - self.position[:, None])[..., None])[..., 0]
        of_turn = -lever(seen)
        p = self.covariance
        of_pose = np.concatenate([np.broadcast_to(-back[:, None], (count, slots, n, n)), of_turn], axis=-1)
        to_pose = p[:, : n + r, b:].reshape(count, n + r, slots, n).transpose(0, 2, 1, 3)
        blocks = p[:, b:, b:].reshape(count, slots, n, slots, n)[:, np.arange(slots), :, np.arange(slots)]
        cross = of_pose @ to_pose @ back[:, None].transpose(0, 1, 3, 2)
        s = of_pose @ p[:, None, : n + r, : n + r] @ of_pose.transpose(0, 1, 3, 2)
        s += cross + cross.transpose(0, 1, 3, 2)
        s += back[:, None] @ blocks.transpose(1, 0, 2, 3) @ self.turn[:, None] + cluster.covariance
        s[self.ids == _FREE] = np.eye(n)
        determinant = np.linalg.det(s)
        inverse = np.linalg.inv(s)
        residual = cluster.point - seen
        chi2 = (residual[..., None, :] @ inverse @ residual[..., None])[..., 0, 0]
        is_possible = (self.ids != _FREE) & (determinant > 0.0) & (chi2 >= 0.0) & (chi2 < self.settings.gate)
        is_possible &= ~are_others(self.sorts, cluster.sort)
        volume = np.log(np.where(is_possible, determinant, 1.0)) + n * np.log(2.0 * np.pi)
        log_likelihood = np.where(is_possible, -0.5 * (chi2 + volume), -np.inf)
        return _Expected(log_likelihood, residual, inverse, of_turn, back)

    def _update(self, source: Ids, options: Ids, what: _Expected) -> None:
        """Kalman updates of the hypotheses that assign the cluster to a landmark of theirs."""
        n, r, b = self._n, self._r, self._base
        which = np.flatnonzero(options < self.ids.shape[1])
        if not len(which):
            return
        slot, i = options[which], source[which]
        back, of_turn = what.back[i], what.of_turn[i, slot]
        whole, p = len(which) == len(options), self.covariance
        p = p if whole else p[which]
        columns = b + n * slot[:, None] + np.arange(n)
        at_landmark = np.take_along_axis(p, np.broadcast_to(columns[:, None], (*p.shape[:2], n)), axis=2)
        pht = (at_landmark - p[:, :, :n]) @ back.transpose(0, 2, 1) + p[:, :, n : n + r] @ of_turn.transpose(0, 2, 1)
        gain = pht @ what.inverse[i, slot]
        p -= gain @ pht.transpose(0, 2, 1)
        if not whole:
            self.covariance[which] = p
        step = (gain @ what.residual[i, slot][..., None])[..., 0]
        self.position[which] += step[:, :n]
        self.turn[which] = self.turn[which] @ rotation(step[:, n : n + r])
        self.scales[which] += step[:, n + r : b]
        self.landmarks[which] += step[:, b:].reshape(len(which), -1, n)
        self.last[which, slot] = self._scans

    # -- landmarks that come and go ----------------------------------------------------------------------------------

    def _begin(self, which: Ids, cluster: Cluster, number: int) -> None:
        """Add a new landmark at the cluster, in some hypotheses."""
        if not len(which):
            return
        n, r = self._n, self._r
        slot = self._slots_for(which)
        turn, p = self.turn[which], self.covariance[which]
        away = (turn @ cluster.point[:, None])[..., 0]
        j = np.concatenate([np.broadcast_to(np.eye(n), turn.shape), turn @ lever(cluster.point)], axis=-1)
        rows = j @ p[:, : n + r]
        own = rows[:, :, : n + r] @ j.transpose(0, 2, 1) + turn @ cluster.covariance @ turn.transpose(0, 2, 1)
        self._place(which, slot, self.position[which] + away, rows, own, number, cluster.sort)

    def recall(self, number: int, sort: str, points: Array, rows: Array, own: Array) -> None:
        """Bring back a landmark in all hypotheses, with its position (K, n) and covariance, as for a new one."""
        which = np.arange(len(self.ids))
        slot = self._slots_for(which)
        whole = np.pad(rows, ((0, 0), (0, 0), (0, self.covariance.shape[1] - rows.shape[2])))
        self._place(which, slot, points, whole, own, number, sort)

    @property
    def is_sound(self) -> bool:
        """Return whether all values are finite."""
        return bool(
            np.isfinite(self.covariance).all()
            and np.isfinite(self.position).all()
            and np.isfinite(self.landmarks).all()
        )

    def _place(self, which: Ids, slot: Ids, points: Array, rows: Array, own: Array, number: int, sort: str) -> None:
        """Store a landmark in some hypotheses, with its cross-covariance (m, n, D) and covariance (m, n, n)."""
        n, b = self._n, self._base
        columns = b + n * slot[:, None] + np.arange(n)
        p = self.covariance
        p[which[:, None], columns] = rows
        p[which[:, None], :, columns] = rows
        p[which[:, None, None], columns[:, :, None], columns[:, None]] = own
        self.landmarks[which, slot] = points
        self.ids[which, slot], self.sorts[which, slot] = number, sort
        self.last[which, slot] = self._scans

    def _slots_for(self, which: Ids) -> Ids:
        """A free slot in each hypothesis; if there is none, that of the landmark not seen for longest."""
        is_free = self.ids[which] == _FREE
        if not is_free.any(axis=1).all() and self.ids.shape[1] < self.settings.slots:
            self._grow(min(_MORE_SLOTS, self.settings.slots - self.ids.shape[1]))
            is_free = self.ids[which] == _FREE
        order = np.where(is_free, -1, self.last[which])
        slot: Ids = order.argmin(axis=1)
        n, b = self._n, self._base
        columns = b + n * slot[:, None] + np.arange(n)
        self.covariance[which[:, None], columns] = 0.0
        self.covariance[which[:, None], :, columns] = 0.0
        return slot

    def _grow(self, more: int) -> None:
        count, n = len(self.ids), self._n
        self.ids = np.concatenate([self.ids, np.full((count, more), _FREE)], axis=1)
        self.sorts = np.concatenate([self.sorts, np.full((count, more), "", dtype=object)], axis=1)
        self.last = np.concatenate([self.last, np.zeros((count, more), dtype=np.int64)], axis=1)
        self.landmarks = np.concatenate([self.landmarks, np.zeros((count, more, n))], axis=1)
        self.covariance = np.pad(self.covariance, ((0, 0), (0, n * more), (0, n * more)))

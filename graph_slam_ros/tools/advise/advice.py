"""Advice on what to measure next: which single addition makes the weakest pose or landmark of a run better known.

The sigma that an addition leaves is predicted by a low-rank update of the marginals of the solver. With A the whitened
Jacobian of what is added, Sigma the joint covariance of its vertices, and a the direction that counts::

    var' = a' Sigma a - (A Sigma a)' (I + A Sigma A')^-1 (A Sigma a)

One joint covariance of a bounded sample of keyframes and landmarks is computed, so that the time is bounded, too.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.tools.advise.additions import (
    CLOSURE,
    NEW,
    SIGHTING,
    SURVEY,
    TAG,
    Addition,
    Additions,
    stored_values,
)
from graph_slam_ros.tools.advise.weakness import Weakness
from graph_slam_ros.typing import Array

KINDS = (SIGHTING, SURVEY, CLOSURE, TAG)
_ON_PATH = 60  # keyframes by which the error of the whole path is judged
_COLUMNS = 600  # degrees of freedom of the sampled keyframes, and as many of landmarks
_EVALUATED = 2000  # additions of each kind
_CLOSURE_M, _APART = 2.0, 5.0  # between the ends of a closure; along the path as many times that
_PLACES = 40  # keyframes near which a new tag is tried
_LEAST_GAIN = 0.02  # of the sigma: what gains less is no advice


@dataclass(frozen=True, slots=True)
class Advice:
    """An addition with what it gains.

    Attributes
    ----------
    predicted : sigma of the weakest direction with the addition [m or rad]
    path_now_m, path_m : root mean square of the position sigmas of the sampled keyframes, as it is and with it
    """

    addition: Addition
    predicted: float
    path_now_m: float
    path_m: float


class Advisor:
    """Predictions for one run.

    Parameters
    ----------
    survey_sigma : as of ``Additions``

    Attributes
    ----------
    weakest : the weakest position, heading and landmark
    keyframes, landmarks : the sample: indices of keyframes, and names
    """

    def __init__(self, weakness: Weakness, survey_sigma: float = 0.02) -> None:
        self._weakness, self._run = weakness, weakness.run
        self._space, self._graph = weakness.run.space, weakness.run.graph
        self.weakest = list(weakness.weakest())
        self.keyframes = self._sampled_keyframes()
        self.landmarks = self._sampled_landmarks()
        self._survey_sigma = survey_sigma
        self._join()

    # -- the sample ------------------------------------------------------------------------------------------------

    def _sampled_keyframes(self) -> list[int]:
        """All keyframes; of a long run those near what is weakest, and the others evenly."""
        count, n = len(self._run.keyframes), self._space.dimensions
        most = _COLUMNS // self._space.dof
        if count <= most:
            return list(range(count))
        chosen = {*np.linspace(0, count - 1, most // 3).astype(int).tolist(), *(one.keyframe for one in self.weakest)}
        share = (most - len(chosen)) // len(self.weakest)
        positions = self._weakness.poses[:, :n]
        for one in self.weakest:
            order = np.argsort(np.linalg.norm(positions - np.array(one.value[:n]), axis=1), kind="stable")
            chosen |= set([k for k in order.tolist() if k not in chosen][:share])
        return sorted(chosen)

    def _sampled_landmarks(self) -> list[str]:
        """The landmarks near what is weakest, the nearest first."""
        n, landmarks = self._space.dimensions, self._run.landmarks
        names = [name for name in landmarks if landmarks[name] not in self._run.held]
        if not names:
            return []
        at = np.array([self._weakness.value(landmarks[name])[:n] for name in names])
        near = np.min([np.linalg.norm(at - np.array(one.value[:n]), axis=1) for one in self.weakest], axis=0)
        dofs = max(self._graph.kind_of(landmarks[name]).dof for name in names)
        return [names[k] for k in np.argsort(near, kind="stable")[: _COLUMNS // dofs].tolist()]

    def _join(self) -> None:
        """Compute the joint covariance of the sample, and that of each weakest direction with it."""
        run = self._run
        vertices = [run.keyframes[k] for k in self.keyframes] + [run.landmarks[name] for name in self.landmarks]
        vertices += [one.vertex for one in self.weakest]
        thirds = {v for e in run.entries if e.is_in and e.landmark for v in e.vertices[2:]}
        unique = list(dict.fromkeys([*vertices, *sorted(thirds)]))
        joint = run.solver.joint_marginal(unique)
        first = np.cumsum([0, *(self._graph.kind_of(v).dof for v in unique)])
        self._columns = {v: np.arange(first[k], first[k + 1]) for k, v in enumerate(unique)}
        n = self._space.dimensions
        self._on_path = self.keyframes[:: -(-len(self.keyframes) // _ON_PATH)]
        at = [self._columns[run.keyframes[k]][:n] for k in self._on_path]
        self._path = np.concatenate(at)  # body axes: the sum over a position is the same in any
        self._joint = joint
        functionals = np.zeros((len(joint), len(self.weakest)))
        for k, one in enumerate(self.weakest):
            functionals[self._columns[one.vertex], k] = one.functional
        self._with_weakest = joint @ functionals
        self._now = np.einsum("ij,ij->j", functionals, self._with_weakest)
        self._path_now = float(np.diag(joint)[self._path].sum())

    # -- predictions -----------------------------------------------------------------------------------------------

    def rows(self, addition: Addition) -> tuple[Array, Array]:
        """The whitened Jacobian (m, c) of an addition, and its columns (c,) in the joint covariance.

        A new landmark is eliminated: what remains is what its sightings together say of the poses.
        """
        values, blocks = self._run.solver.values, []
        wide: dict[int, int] = {}
        for edge in addition.edges:
            x, at = stored_values(self._graph, values, edge, addition.value)
            _, jacobian = edge.type.linearize(x, at, edge.measured[None])
            white, place = edge.share**0.5 * edge.noise.sqrt_information @ jacobian[0], 0
            for vertex, dof in zip(edge.vertices, edge.type.dofs, strict=True):
                wide.setdefault(vertex, dof)
                blocks.append((len(white), vertex, white[:, place : place + dof]))
                place += dof
        starts = dict(zip(wide, np.cumsum([0, *wide.values()]).tolist(), strict=False))
        out = np.zeros((sum(len(e.noise.sqrt_information) for e in addition.edges), sum(wide.values())))
        row, filled = 0, iter(blocks)
        for edge in addition.edges:
            for _ in edge.vertices:
                height, vertex, block = next(filled)
                out[row : row + height, starts[vertex] : starts[vertex] + wide[vertex]] = block
            row += height
        return self._eliminated(out, starts, wide)

    def _eliminated(self, rows: Array, starts: dict[int, int], wide: dict[int, int]) -> tuple[Array, Array]:
        columns = np.concatenate([self._columns[v] for v in wide if v != NEW])
        if NEW not in wide:
            return rows, columns
        new = np.arange(starts[NEW], starts[NEW] + wide[NEW])
        left, singular, _ = np.linalg.svd(rows[:, new])
        rank = int((singular > 1e-9 * singular.max(initial=0.0)).sum())
        return left[:, rank:].T @ np.delete(rows, new, axis=1), columns

    def predict(self, addition: Addition) -> tuple[Array, float]:
        """Predict the sigma of each weakest direction, and the root mean square of the position sigmas on the path."""
        a, columns = self.rows(addition)
        innovation = np.eye(len(a)) + a @ self._joint[np.ix_(columns, columns)] @ a.T
        root = np.linalg.cholesky(innovation)
        gain = np.linalg.solve(root, a @ self._with_weakest[columns])
        of_path = np.linalg.solve(root, a @ self._joint[np.ix_(columns, self._path)])
        left = np.maximum(self._now - (gain**2).sum(axis=0), 0.0)
        path = max(self._path_now - float((of_path**2).sum()), 0.0)
        return np.sqrt(left), float(np.sqrt(path / len(self._on_path)))

    def advise(self, kinds: Sequence[str] = KINDS) -> list[list[Advice]]:
        """Evaluate all additions; returns for each of ``weakest`` what helps, the best first."""
        out: list[list[Advice]] = [[] for _ in self.weakest]
        path_now = float(np.sqrt(self._path_now / len(self._on_path)))
        for addition in self.additions(kinds):
            sigmas, path = self.predict(addition)
            for k, now in enumerate(np.sqrt(self._now)):
                if sigmas[k] < (1.0 - _LEAST_GAIN) * now:
                    out[k].append(Advice(addition, float(sigmas[k]), path_now, path))
        return [sorted(some, key=lambda one: one.predicted) for some in out]

    def additions(self, kinds: Sequence[str] = KINDS) -> Iterator[Addition]:
        """The additions that are possible, of each kind at most a bounded number."""
        known = Additions(self._run, self.keyframes, self._weakness.travelled_m, self._survey_sigma)
        makers = {
            SIGHTING: lambda: known.sightings(self.landmarks),
            SURVEY: lambda: known.surveys(self.landmarks),
            CLOSURE: lambda: known.closures(_CLOSURE_M, _APART, _EVALUATED // 10),
            TAG: lambda: known.tags(self._places()),
        }
        for kind in kinds:
            for _, addition in zip(range(_EVALUATED), makers[kind](), strict=False):
                yield addition

    def why_nothing(self) -> str:
        """Return the reason why nothing may be found that helps, in words."""
        if not self.landmarks:
            return "the run has no landmark, and its path comes back to no place; drive past tags, or back to the start"
        return f"no landmark near it can be seen better, and no tag along the path helps by {_LEAST_GAIN:.0%}"

    def _places(self) -> list[int]:
        """The keyframes at which a new tag is tried: those near what is weakest."""
        n, positions = self._space.dimensions, self._weakness.poses[self.keyframes][:, : self._space.dimensions]
        near = np.min([np.linalg.norm(positions - np.array(one.value[:n]), axis=1) for one in self.weakest], axis=0)
        nearest = np.argsort(near, kind="stable")[: 2 * _PLACES].tolist()
        return sorted(self.keyframes[k] for k in nearest[::2])

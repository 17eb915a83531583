"""An update in one compiled call: what arrives enters, is linearised and solved, and what is far is moved.

Where Python is needed the call ends early, and is made again from the next stage on.
"""

from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.blocks import linearize_edges
from graph_slam_ros.solver.clique_tree.advance import DISSECT, advance_tree
from graph_slam_ros.solver.clique_tree.incremental import enter, reach_back
from graph_slam_ros.solver.clique_tree.pointers import kept_of, tree_of
from graph_slam_ros.solver.clique_tree.storage import NOTHING, ZERO, Limits
from graph_slam_ros.solver.entry import ANCHORED, how_anchored
from graph_slam_ros.solver.relinearization import MAYBE, SURELY
from graph_slam_ros.typing import Index

CHECK, LINEARIZE, ORDER, GROUP, END = range(5)  # stages: where the call begins; after the last there is nothing to do
UNSURE, SEARCH, IN_PYTHON = range(DISSECT + 1, DISSECT + 4)  # how it ends where the tree was not advanced


@kernel
def update(
    graph: Index,
    pointers: Index,
    stage: int,
    due: int,
    vertices: Index,
    edges: Index,
    linear: Index,
    again: Index,
    touched: Index,
    unseen: Index,
    young: Index,
    losses: Index,
    tolerance: float,
    sigmas: float,
    far: Limits,
) -> tuple[int, int, int, Index]:
    """Integrate vertices and edges into the solution of a problem.

    Parameters
    ----------
    graph, pointers : those of the graph, and of the problem
    stage : CHECK: all of it; LINEARIZE: they have entered; ORDER: they are linearised; GROUP: their tail is moved
    due : whether all vertices that moved are to be searched for large steps (``RelinearizationSchedule.is_due``)
    vertices, edges : that enter or have changed
    linear : edges to linearise: these, and those ``again`` that are far from where they were linearised
    touched, unseen, tolerance, sigmas, far : see ``advance_tree``
    young, losses : edges held to the first stage of their loss; pointers of the losses of first and last stage

    Returns
    -------
    What ``advance_tree`` returns; or, and the rest says nothing:

    * UNSURE: it may be that nothing fixes a vertex, or one is held, or an edge has no weight. Nothing was changed
    * SEARCH: they have entered, and it is time to search
    * IN_PYTHON: an edge is not compiled, or its cost is not finite; all are to be linearised in Python
    """
    t, nothing = tree_of(pointers), vertices[:0]
    if stage <= CHECK:
        if how_anchored(t, graph, pointers, vertices, edges) != ANCHORED:
            return UNSURE, ZERO, ZERO, nothing
        enter(t, vertices, edges)
        if due == SURELY or (due == MAYBE and reach_back(t, edges)):
            return SEARCH, ZERO, ZERO, nothing
    if stage <= LINEARIZE:
        table, _ = linearize_edges(t, graph, linear, losses[4:], young, losses[:4])
        if table != NOTHING:
            return IN_PYTHON, ZERO, ZERO, nothing
    tail = stage <= ORDER
    return advance_tree(t, kept_of(pointers), edges, touched, vertices, tail, again, unseen, tolerance, sigmas, far)

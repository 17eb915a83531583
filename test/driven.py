"""Runs for tests, as a node records them."""

from dataclasses import replace

from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.slam import Control, GraphSlam, Sightings


def drive(folder, config, world, start=None):
    """A run that is flushed update by update and that nobody ends; what is returned is solved until nothing moves."""
    recorder = RunRecorder(folder, config, start=start)
    slam = GraphSlam(config, recorder.sink, start=start)
    for m in [*world, Control("end"), Control("optimize")]:
        recorder.record(slam, slam.process(m))
        recorder.flush()
    slam.view.solver.optimize(slam.view.solver.settings.until_still())
    slam.view.solver.update()  # so that covariances are at hand
    return slam


def seldom(world, each=2):
    """One of so many messages with sightings: half the keyframes of the same drive."""
    count = 0
    for m in world:
        count += isinstance(m, Sightings)
        if not isinstance(m, Sightings) or count % each == 1:
            yield m


def without_names(world):
    for m in world:
        if isinstance(m, Sightings):
            m = replace(m, sightings=tuple(replace(one, id="") for one in m.sightings))
        yield m

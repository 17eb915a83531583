"""Checks of the frames of a recording: which are linked to the robot, and by how many publishers."""

from collections.abc import Iterator, Sequence

from graph_slam_ros.check.columns import MOST, Columns, SightingColumns
from graph_slam_ros.config.inputs import ASSUMED
from graph_slam_ros.findings.finding import Finding, Severity
from graph_slam_ros.formats.parameters import assignment
from graph_slam_ros.messages.inputs.transforms import MAP_FRAMES, assumed_mount
from graph_slam_ros.overview.contents import root_of

_OF_CAMERAS = "world"  # which visual odometry calls its frame, too
_FIXED = (*MAP_FRAMES, _OF_CAMERAS)
_UNKNOWN = ("frame_unknown", "child_frame_unknown", "odom_frame_unknown", "map_frame_unknown")


def check_frames(c: Columns) -> Iterator[Finding]:
    """The tree of transforms, and where odometry and each sensor are in it."""
    yield from _parents(c)
    if c.odometry.frame in _FIXED:
        is_common = c.odometry.frame == _OF_CAMERAS
        severity: Severity = "note" if is_common else "warning"
        localiser = "the output of a localiser"
        what = f"visual odometry, or {localiser}" if is_common else f"{localiser}, not odometry"
        text = f"given in frame {c.odometry.frame}: it is {what}"
        yield c.odometry.finding("odometry_in_map", severity, 1, 0, "topics", text, 0)
    unlinked = set()
    for s in c.sightings:
        found = list(_of_sensor(c, s))
        unlinked |= {one.topic for one in found}
        yield from found
    yield from _unlinked(c, unlinked)


def _parents(c: Columns) -> Iterator[Finding]:
    parents: dict[str, dict[str, None]] = {}
    for parent, child in c.links:
        parents.setdefault(child, {})[parent] = None
    used = {s.frame for s in c.sightings} | {c.config.frames.base, c.odometry.child}
    for frame in tuple(used):
        while frame in parents and (above := next(iter(parents[frame]))) not in used:
            used.add(above)
            frame = above
    for child, several in parents.items():
        if len(several) > 1 and child in used:
            text = f"frame {child} has {len(several)} parents ({', '.join(list(several)[:4])}): two nodes publish it"
            yield Finding("two_parents", "error", len(several), 1, "parents", text, "/tf")


def _of_sensor(c: Columns, s: SightingColumns) -> Iterator[Finding]:
    topic = c.topics[s.topic]
    fixed = [frame for frame in topic.frames if frame.lstrip("/") in (*_FIXED, c.odometry.frame) and frame]
    if fixed:
        is_linked = (fixed[0].lstrip("/"), c.odometry.child) in c.links
        text = f"given in {fixed[0]}, a frame that does not move with the robot"
        severity: Severity = "note" if is_linked else "error"
        yield topic.finding("seen_in_fixed_frame", severity, topic.frames[fixed[0]], 0, "messages", text)
    elif f"{s.input}.frame" in c.assumed:
        text = f"no transform has {next(iter(topic.frames))}: did you mean {s.frame}?"
        settings = (assignment(f"{s.input}.frame", s.frame),)
        yield topic.finding("frame_unlinked", "error", 1, 0, "frames", text, settings=settings)
    elif next((one.mount for one in c.config.sources if one.name == s.input), "") == ASSUMED:
        named = next(filter(None, topic.frames), "") or "its sensor, whose messages name no frame,"
        assumed = f"a place at the base is assumed, as by --set '{s.input}.mount={assumed_mount(s.frame)}'"
        text = f"no transform links {named} to {c.config.frames.base}: {assumed}"
        yield topic.finding("frame_unlinked", "error", 1, 0, "frames", text)


def _unlinked(c: Columns, known: set[str]) -> Iterator[Finding]:
    """Messages that were refused since nothing links their frame, and odometry whose child frame is assumed."""
    for source, counts in c.counters.as_dict().items():
        topic = c.topic_of(source)
        times = sum(counts.get(reason, 0) for reason in _UNKNOWN)
        if topic is None or not times or topic.topic in known:
            continue
        frames, base = tuple(topic.frames), c.config.frames.base
        above = {child: parent for parent, child in c.links}
        root = root_of(above, base.lstrip("/"))
        of_sensor = frames if "frame_unknown" in counts else ()  # else it is that of odometry, or of a map
        linked = [frame for frame in of_sensor if frame and root_of(above, frame.lstrip("/")) == root]
        lost = ", ".join([frame for frame in frames if frame not in linked][:4])
        others = ", ".join(linked[:4])
        text = f"{times} measurements are refused: no transform links frame {lost} to {base}"
        settings = () if linked else _place(c, source, frames, lost, "odom_frame_unknown" in counts)
        if frames == ("",):
            text = f"{times} measurements name no frame: have their driver fill in header.frame_id"
            yield topic.finding("frame_empty", "error", times, 0, "measurements", text, times)
            continue
        elif linked and lost:  # at a mount, what another robot sees would be seen by this one
            text += f"; the others are of {others}: is it another robot's frame, or a sensor without a transform?"
        elif linked:  # a mount is not used for them
            text = f"{times} measurements are refused: they come before /tf links {others} to {base}"
        severity: Severity = "error" if times > MOST * max(c.counters.received[source], 1) else "warning"
        yield topic.finding("frame_unlinked", severity, times, 0, "measurements", text, times, settings=settings)
    key = f"{c.odometry.input}.mount"
    if key in c.assumed:
        named = c.odometry.child or "its child frame, which is empty,"
        text = f"no transform links {named} to {c.config.frames.base}: one place is assumed"
        settings = (assignment(key, assumed_mount("")),)
        yield c.odometry.finding("frame_unlinked", "warning", 1, 0, "frames", text, 0, settings=settings)


def _place(c: Columns, source: str, names: Sequence[str], lost: str, is_odometry: bool) -> tuple[str, ...]:
    """The setting that gives an input its place: a mount, or where it is the frame of odometry, that."""
    if not is_odometry:
        return (assignment(f"{source}.mount", assumed_mount(lost)),)
    named, frames = next(iter(names), "odom"), c.config.frames
    return (assignment("frames.odom", named) if named != frames.map else assignment(f"{source}.frame", frames.odom),)

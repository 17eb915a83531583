"""Replay: a recording, or the ingest sequence of an earlier run, through ``GraphSlam`` as fast as the CPU allows."""

import shlex
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graph_slam_ros.formats.ingest import read_ingest
from graph_slam_ros.ros.bag import Bag, BagError, open_bag
from graph_slam_ros.ros.definitions import recorded_decoder
from graph_slam_ros.ros.from_msg import DETECTIONS, ODOMETRY, TRANSFORMS, Border
from graph_slam_ros.run import RunRecorder, check_room, is_run, run_config, summarize
from graph_slam_ros.slam import Config, Control, Counters, GraphSlam, Measurement
from graph_slam_ros.slam.measurements import from_record

TF_STATIC = "/tf_static"
_ARROW = " -> "

Progress = Callable[[Iterable[Any], int], Iterable[Any]]


@dataclass(frozen=True, slots=True)
class Inputs:
    """The topics of a recording that are used; ``landmarks`` and ``tf_static`` may be empty."""

    odometry: str
    landmarks: str
    tf_static: str

    def names(self) -> list[str]:
        """Those that are there."""
        return [name for name in (self.odometry, self.landmarks, self.tf_static) if name]


@dataclass(frozen=True, slots=True)
class Replayed:
    """What came of a replay: the pipeline at its end, numbers, and what of the recording could not be read."""

    slam: GraphSlam
    summary: dict[str, Any]
    losses: list[str]


def choose_inputs(bag: Bag, odometry: str | None, landmarks: str | None) -> Inputs:
    """The topics to use: those named, else the one of its type, else the one with the usual name.

    Raises
    ------
    BagError
        A named topic does not exist or has another type, or there is no odometry; the topics that exist are listed.
    """
    return Inputs(
        _choose(bag, ODOMETRY, odometry, "/odom", "--odom", required=True),
        _choose(bag, DETECTIONS, landmarks, "/landmarks", "--landmarks", required=False),
        TF_STATIC if TF_STATIC in bag.topics else "",
    )


def _choose(bag: Bag, type_name: str, named: str | None, usual: str, option: str, *, required: bool) -> str:
    there = ", ".join(f"{t.name} ({t.type or 'no type'})" for t in bag.topics.values())
    if named is not None:
        topic = bag.topics.get(named)
        if topic is None:
            raise BagError(f"no topic {named} in the recording; there are {there}")
        if not topic.type:
            raise BagError(f"topic {named} has no type: the recording lacks its schema")
        if topic.type != type_name:
            raise BagError(f"topic {named} is {topic.type}, not {type_name}")
        return named
    found = [t.name for t in bag.topics.values() if t.type == type_name]
    if usual in found:
        return usual
    if len(found) == 1:
        return found[0]
    if found:
        raise BagError(f"several topics of type {type_name} ({', '.join(found)}): choose one with {option}")
    if required:
        raise BagError(f"no topic of type {type_name} in the recording; there are {there}")
    return ""


def measurements(bag: Bag, inputs: Inputs, config: Config, counters: Counters) -> Iterator[Measurement | None]:
    """What the border makes of each recorded message, in order; None for one it refused.

    Static transforms are read first: they hold for the whole recording.

    Raises
    ------
    BagError
        At once, before anything is read: a recorded definition is not what we can use.
    """
    used = {name: bag.topics[name] for name in inputs.names()}
    types = {inputs.odometry: ODOMETRY, inputs.landmarks: DETECTIONS, inputs.tf_static: TRANSFORMS}
    decoders = {types[name]: recorded_decoder(topic) for name, topic in used.items()}
    return _through(Border(config, counters, decoders), bag, inputs)


def _through(border: Border, bag: Bag, inputs: Inputs) -> Iterator[Measurement | None]:
    if inputs.tf_static:
        for message in bag.messages({inputs.tf_static}):
            border.static_transforms(message.cdr)
    for message in bag.messages({inputs.odometry, inputs.landmarks} - {""}):
        if message.topic == inputs.odometry:
            yield border.odometry(message.cdr)
        else:
            yield border.sightings(message.topic, message.cdr)


def replay(
    source: Path,
    out: Path,
    config: Config | None = None,
    *,
    odometry: str | None = None,
    landmarks: str | None = None,
    progress: Progress = lambda items, total: items,
) -> Replayed:
    """Run a recording, or a run's own ingest sequence, and save a run folder.

    Parameters
    ----------
    source : a bag, or a run folder: then exactly its events are repeated, nothing is added
    config : default: the run's own, or the defaults
    """
    start, cpu = time.perf_counter(), time.process_time()
    counters = Counters()
    check_room(out, source)
    if is_run(source):
        config = config or run_config(source)
        losses: list[str] = []
        items: Iterable[Measurement | None] = map(from_record, read_ingest(source, losses))
        total = 0
    else:
        config = config or Config()
        bag = open_bag(source)
        inputs = choose_inputs(bag, odometry, landmarks)
        items = _with_end(measurements(bag, inputs, config, counters))
        total = sum(bag.topics[name].count for name in (inputs.odometry, inputs.landmarks) if name) + 2
        losses = bag.losses
    recorder = RunRecorder(out, config)
    slam = GraphSlam(config, recorder.sink)
    try:
        for measurement in progress(items, total):
            if measurement is not None:
                recorder.record(slam, slam.process(measurement))
        slam.counters.update(counters)
        took = {"time_s": time.perf_counter() - start, "cpu_s": time.process_time() - cpu}
        summary = summarize(slam) | took | {"losses": list(dict.fromkeys(losses))}
        recorder.save(slam, summary)
    finally:
        recorder.close()
    return Replayed(slam, summary, summary["losses"])


def _with_end(items: Iterable[Measurement | None]) -> Iterator[Measurement | None]:
    """A recording ends: what waits is released, and the whole is solved."""
    yield from items
    yield Control("end")
    yield Control("optimize")


def describe(bag: Bag, path: Path) -> list[str]:
    """Topics, types, rates, frames and span of a recording, and the replay command that fits."""
    span: dict[str, tuple[int, int]] = {}
    frames: dict[str, str] = {}
    decoders = {t.name: recorded_decoder(t) for t in bag.topics.values() if t.type in (ODOMETRY, DETECTIONS)}
    for message in bag.messages(set(bag.topics)):
        first, _ = span.get(message.topic, (message.log_ns, 0))
        span[message.topic] = (first, message.log_ns)
        if message.topic in decoders and message.topic not in frames:
            frames[message.topic] = _frames(decoders[message.topic], message.cdr)
    lines = []
    for name, topic in sorted(bag.topics.items()):
        first, last = span.get(name, (0, 0))
        rate = f"{(topic.count - 1) / ((last - first) * 1e-9):.1f} Hz" if last > first else "-"
        lines.append(f"{name:28s} {topic.type:40s} {topic.count:8d}  {rate:>10s}  {frames.get(name, '')}".rstrip())
    if span:
        first, last = min(a for a, _ in span.values()), max(b for _, b in span.values())
        lines.append(f"span {(last - first) * 1e-9:.3f} s, from {first * 1e-9:.3f}")
    lines.append(_suggestion(bag, path, frames))
    return lines


def _frames(decode: Callable[[bytes], Any], cdr: bytes) -> str:
    try:
        message = decode(cdr)
    except Exception:  # damaged bytes: replay counts them
        return "(undecodable)"
    child = getattr(message, "child_frame_id", "")
    return f"{message.header.frame_id}{_ARROW + child if child else ''}"


def _suggestion(bag: Bag, path: Path, frames: dict[str, str]) -> str:
    try:
        inputs = choose_inputs(bag, None, None)
    except BagError as error:
        return f"not ready for replay: {error}"
    words = ["graph_slam", "replay", str(path), "--odom", inputs.odometry]
    if inputs.landmarks:
        words += ["--landmarks", inputs.landmarks]
    parent, _, child = frames.get(inputs.odometry, "").partition(_ARROW)
    usual = Config().frames
    if parent not in ("", usual.odom):
        words += ["--set", f"frames.odom={parent}"]
    if child not in ("", usual.base):
        words += ["--set", f"frames.base={child}"]
    return shlex.join([*words, "--out", "run"])

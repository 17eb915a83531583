"""Replay: a recording, or the ingest sequence of an earlier run, through ``GraphSlam`` as fast as the CPU allows."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from graph_slam_ros.config.inputs import InputConfig, default_input
from graph_slam_ros.measurements.reasons import warnings as mendable
from graph_slam_ros.measurements.types import Measured, from_record
from graph_slam_ros.messages.from_msg import TF, TF_STATIC, TRANSFORMS, MessageConverter
from graph_slam_ros.messages.inputs import uses
from graph_slam_ros.messages.survey import with_survey
from graph_slam_ros.recordings.bag import Bag, BagError, open_bag
from graph_slam_ros.recordings.definitions import recorded_decoder
from graph_slam_ros.runs import (
    RunError,
    check_room,
    config_of,
    is_run,
    map_of,
    missing,
    record_run,
    recording_of,
    run_config,
    stopwatch,
)
from graph_slam_ros.runs.journal import read_ingest
from graph_slam_ros.runs.map_journal import read_map
from graph_slam_ros.slam import Config, Control, Counters, GraphSlam, Measurement
from graph_slam_ros.slam.frontend.time_jump import TimeJumpDetector
from graph_slam_ros.warmup import warmup

TF_STATIC_TOPIC, TF_TOPIC = "/tf_static", "/tf"
_OPTIONS = {"odometry": "--odom", "landmarks": "--landmarks"}
_OPTIONAL = default_input("detections")  # a recording need not have what nobody asked for

Progress = Callable[[Iterable[Any], int], Iterable[Any]]


@dataclass(frozen=True, slots=True)
class Inputs:
    """The topics of a recording that are used, by the name of the input, ``tf_static`` and ``tf`` included."""

    topics: Mapping[str, str]

    def by_topic(self) -> dict[str, list[str]]:
        """Names of the inputs of each topic that is read in order of recording; ``tf`` is the first of its own."""
        out: dict[str, list[str]] = {}
        for name in sorted(self.topics, key=lambda name: name != TF):
            if name != TF_STATIC:
                out.setdefault(self.topics[name], []).append(name)
        return out


@dataclass(frozen=True, slots=True)
class Replayed:
    """What came of a replay: the pipeline at its end, numbers, what could not be read, and what to beware of."""

    slam: GraphSlam
    summary: dict[str, Any]
    losses: list[str]
    warnings: list[str]


def choose_inputs(bag: Bag, config: Config, odometry: str | None = None, landmarks: str | None = None) -> Inputs:
    """The topic of each input: the one named, else the configured one, else the only one of its type.

    Parameters
    ----------
    odometry, landmarks : topics of the first input that is used so, whatever is configured

    Raises
    ------
    BagError
        A named topic does not exist or has another type, or there is none; the topics that exist are listed.
    """
    named = {"odometry": odometry, "landmarks": landmarks}
    by_name = {settings.name: settings for settings in config.sources}
    topics = {}
    for name, use in uses(config).items():
        option, topic = _OPTIONS.get(use) if use in named else None, named.pop(use, None)
        found = _choose(bag, by_name[name], topic, option or f"--set {name}.topic=")
        if found:
            topics[name] = found
    if named.get("landmarks"):
        raise BagError(f"no input is used as landmarks: {landmarks} cannot be one")
    if TF_STATIC_TOPIC in bag.topics:
        topics[TF_STATIC] = TF_STATIC_TOPIC
    if config.inputs.tf and TF_TOPIC in bag.topics and bag.topics[TF_TOPIC].type == TRANSFORMS:
        topics[TF] = TF_TOPIC
    return Inputs(topics)


def _choose(bag: Bag, settings: InputConfig, named: str | None, option: str) -> str:
    there = ", ".join(f"{t.name} ({t.type or 'no type'})" for t in bag.topics.values())
    usual = f"/{settings.topic.lstrip('/')}"
    if named is None and settings.topic != default_input(settings.name).topic:
        named = usual
    if named is not None:
        topic = bag.topics.get(named)
        if topic is None:
            raise BagError(f"no topic {named} in the recording; there are {there}")
        if not topic.type:
            raise BagError(f"topic {named} has no type: the recording lacks its schema")
        if topic.type != settings.type:
            raise BagError(f"topic {named} is {topic.type}, not {settings.type}")
        return named
    found = [t.name for t in bag.topics.values() if t.type == settings.type and t.name != TF_STATIC_TOPIC]
    if usual in found:
        return usual
    if len(found) == 1:
        return found[0]
    if found:
        raise BagError(f"several topics of type {settings.type} ({', '.join(found)}): choose one with {option}")
    if settings != _OPTIONAL:
        raise BagError(f"no topic of type {settings.type} in the recording; there are {there}")
    return ""


def measurements(
    bag: Bag, inputs: Inputs, config: Config, counters: Counters, datum: tuple[float, ...] = ()
) -> Iterator[list[Measured | Control]]:
    """What the border makes of each recorded message, in order, and at the end of what has waited.

    Where the stamps of odometry begin anew, a segment does. Static transforms are read first: they hold for the whole
    recording.

    Parameters
    ----------
    datum : where on earth the map begins: latitude [deg], longitude [deg], height [m]; empty: at the first fix

    Raises
    ------
    BagError
        At once, before anything is read: a recorded definition is not what we can use.
    """
    used = [bag.topics[topic] for topic in inputs.topics.values()]
    border = MessageConverter(config, counters, {topic.type: recorded_decoder(topic) for topic in used})
    for name in counters.received.keys() - inputs.topics.keys():
        del counters.received[name]  # nobody asked for it
    if datum:
        border.begin_at(datum)
    return _through(border, bag, inputs, TimeJumpDetector(config.time.jump_back_s))


def _through(
    border: MessageConverter, bag: Bag, inputs: Inputs, jump: TimeJumpDetector
) -> Iterator[list[Measured | Control]]:
    if TF_STATIC in inputs.topics:
        for message in bag.messages({inputs.topics[TF_STATIC]}):
            border.take(TF_STATIC, message.cdr)
    by_topic = inputs.by_topic()
    for message in bag.messages(set(by_topic)):
        measured = [m for name in by_topic[message.topic] for m in border.take(name, message.cdr)]
        if jump.is_jump(measured):
            border.forget_time()
            jump.forget()
            yield [Control("time_jump"), *measured]
        else:
            yield [*measured]
    yield [*border.finish()]


def replay(
    source: Path | str,
    out: Path | str,
    config: Config | None = None,
    *,
    odometry: str | None = None,
    landmarks: str | None = None,
    map_folder: Path | str | None = None,
    force: bool = False,
    progress: Progress = lambda items, total: items,
) -> Replayed:
    """Run a recording, or a run's own ingest sequence, and save a run folder.

    Parameters
    ----------
    source : a bag, or a run folder: then exactly its events are repeated, nothing is added
    config : default: the run's own, that of the map, or the defaults
    map_folder : the run whose map is gone on in: where the robot is in it shows when it recognises something
    force : a run in ``out`` may be replaced

    Raises
    ------
    GraphSlamError
        The source, the map or an input cannot be used.
    """
    took = stopwatch()
    source, out = Path(source), Path(out)
    border = Counters()
    check_room(out, source, force=force)
    state = None
    if is_run(source):
        if map_folder is not None:
            raise RunError(f"{source}: a run is repeated in the map that it began in; a map is for a recording")
        config, own = with_survey(config or run_config(source)), run_config(source)
        if config.world != own.world:
            raise RunError(f"{source}: world.dimensions is {own.world.dimensions} there")
        losses, warnings, total = missing(source), list[str](), 0
        state = read_map(source, losses, start_only=True)
        items: Iterable[Sequence[Measurement]] = ([from_record(record)] for record in read_ingest(source, losses))
    else:
        of_map: list[str] = []
        if map_folder is not None:
            state = map_of(Path(map_folder), of_map)
            config = config or config_of(Path(map_folder), state)
        config = with_survey(config or Config())
        bag = open_bag(source)
        inputs = choose_inputs(bag, config, odometry, landmarks)
        items = _with_end(measurements(bag, inputs, config, border, state.datum if state is not None else ()))
        total = sum(bag.topics[topic].count for topic in inputs.by_topic()) + 3
        bag.losses += of_map
        losses, warnings = bag.losses, bag.warnings
    warmup()
    one_by_one = chain.from_iterable(progress(items, total))
    name = recording_of(source) if is_run(source) else source.resolve().name
    slam, summary = record_run(
        out, config, one_by_one, losses, state, border=border, took=took, recording=name, force=force
    )
    told = [*map(str, slam.alarms), *mendable(summary["counters"])]
    return Replayed(slam, summary, summary["losses"], [*warnings, *told])


def _with_end(items: Iterable[Sequence[Measurement]]) -> Iterator[Sequence[Measurement]]:
    """A recording ends: what waits is released, and the whole is solved."""
    yield from items
    yield [Control("end")]
    yield [Control("optimize")]

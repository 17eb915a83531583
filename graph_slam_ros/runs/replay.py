"""Replay: a recording, or the ingest sequence of an earlier run, through ``GraphSlam`` as fast as the CPU allows."""

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import chain, groupby, islice
from operator import attrgetter, itemgetter
from pathlib import Path
from types import MappingProxyType
from typing import Any

from graph_slam_ros.check.checks import first_of_replay, worst_of_replay
from graph_slam_ros.check.columns import Collector, Columns
from graph_slam_ros.config.config import with_survey
from graph_slam_ros.measurements.types import END, Measured, Odometry
from graph_slam_ros.messages.from_msg import TF_STATIC, MessageConverter
from graph_slam_ros.overview.chosen_inputs import Inputs, choose_inputs
from graph_slam_ros.recordings.bag import Bag, BagMessage, open_bag
from graph_slam_ros.recordings.definitions import recorded_decoder
from graph_slam_ros.runs.folder import RunError, check_room, is_run, keep_earlier, missing, recording_of, run_config
from graph_slam_ros.runs.journal import read_measurements
from graph_slam_ros.runs.map_file import read_start
from graph_slam_ros.runs.outcome import doubts, is_undecided, of_run, unscaled
from graph_slam_ros.runs.restore import Stopwatch, config_of, map_of, record_run, stopwatch
from graph_slam_ros.slam import Config, Control, Counters, GraphSlam, MapView
from graph_slam_ros.slam.frontend.ingest_gate import IngestGate
from graph_slam_ros.warmup import warmup

_FEWEST, _MOST_TOGETHER = 4, 100  # messages that are converted together
_READ_AHEAD = 20_000  # messages that are checked before anything is processed: minutes, and some megabytes

Progress = Callable[[Iterable[Any], int], Iterable[Any]]


@dataclass(frozen=True, slots=True)
class Replayed:
    """The result of a replay: the pipeline at its end, the summary, what could not be read, and warnings.

    Attributes
    ----------
    earlier : folder and summary of each run before the last, which ended by ``time.on_jump: reset``
    topics : of the recording that were read
    """

    slam: GraphSlam
    summary: dict[str, Any]
    losses: list[str]
    warnings: list[str]
    earlier: tuple[tuple[Path, dict[str, Any]], ...] = ()
    topics: tuple[str, ...] = ()


class RecordedRuns:
    """The measurements of each message of a recording, in order, with the number of their run.

    If the stamps of odometry begin anew, ``time.on_jump`` decides what happens to the run. Static transforms are read
    first, because they hold for the whole recording.

    ``datum``: where on earth the map begins (latitude [deg], longitude [deg], height [m]; empty: at the first fix).
    ``assumed``: parameters that were chosen for the recording. ``counted``: what was counted when each run but the last
    ended. Raises BagError: a recorded definition is not what we can use.
    """

    def __init__(
        self,
        bag: Bag,
        inputs: Inputs,
        config: Config,
        datum: tuple[float, ...] = (),
        assumed: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self._bag, self._inputs, self.counters = bag, inputs, Counters()
        self._columns = Collector(config, inputs.topics, assumed)
        self._on_jump = config.time.on_jump
        self._gate = IngestGate(self.counters)
        self.count = sum(bag.topics[topic].count for topic in inputs.by_topic())
        self.counted: list[Counters] = []
        used = [bag.topics[topic] for topic in inputs.topics.values()]
        decoders = {topic.type: recorded_decoder(topic) for topic in used}
        self._converter = MessageConverter(config, self.counters, decoders)
        self._converter.on_fault = bag.warnings.append
        for name in self.counters.received.keys() - inputs.topics.keys():
            del self.counters.received[name]  # nobody asked for it
        if datum:
            self._converter.begin_at(datum)

    def __iter__(self) -> Iterator[tuple[int, list[Measured | Control]]]:
        """Yield the number of the run, from 0, and the measurements of each message, the end of a run included."""
        bag, by_topic = self._bag, self._inputs.by_topic()
        if TF_STATIC in self._inputs.topics:
            for message in bag.messages({self._inputs.topics[TF_STATIC]}):
                self._collect(message, [TF_STATIC], self._converter.convert(TF_STATIC, message.cdr))
        for messages in _stretches(bag.messages(set(by_topic))):
            names = by_topic[messages[0].topic]
            run = self._run(messages, names)
            for m in self._gate.admit(run, self._on_jump).measured:  # which are no jump
                yield len(self.counted), [m]
            for message in messages[len(run) :]:
                measured = [m for name in names for m in self._converter.convert(name, message.cdr)]
                self._collect(message, names, measured)
                yield from self._passed(measured, names)
        yield from self._passed(self._converter.finish(), ())

    def _run(self, messages: Sequence[BagMessage], names: Sequence[str]) -> list[Odometry]:
        """The odometry of the first messages of a topic, as far as they can be converted at once."""
        if len(messages) < _FEWEST or len(names) > 1:
            return []
        run = self._converter.convert_run(names[0], [m.cdr for m in messages], self._gate.newest_ns(names[0]))
        if run:
            log_ns = [m.log_ns for m in messages[: len(run)]]
            self._columns.add_run(messages[0].topic, log_ns, run, self._converter.decoded)
        return run

    def _collect(self, message: BagMessage, names: Sequence[str], measured: list[Measured]) -> None:
        self._columns.add(message.topic, names, message.log_ns, measured, self._converter.decoded)

    def _passed(self, measured: list[Measured], names: Sequence[str]) -> Iterator[tuple[int, list[Measured | Control]]]:
        passage = self._gate.admit(measured, self._on_jump)
        if passage.jump:
            self._converter.forget_time()
        if passage.jump == "reset":
            for event in END:
                yield len(self.counted), [event]
            self.counted.append(self._counted_before(names))
        yield len(self.counted), [*passage.events, *passage.measured]

    def columns(self) -> Columns:
        """Return what the checks of a recording look into, of the messages until now."""
        return self._columns.columns(self.counters)

    def counted_in(self, number: int) -> Counters:
        """The counts of one run, by its number; of the last run, until now."""
        end = self.counted[number] if number < len(self.counted) else self.counters
        return end.since(self.counted[number - 1] if number else Counters())

    def _counted_before(self, names: Sequence[str]) -> Counters:
        """The counts before a message of these inputs that belongs to the next run."""
        before = Counters()
        before.update(self.counters)
        before.received.subtract(names)
        return before


def _stretches(messages: Iterable[BagMessage]) -> Iterator[list[BagMessage]]:
    """Messages in order, those of one topic that follow one another together."""
    for _, of_topic in groupby(messages, key=attrgetter("topic")):
        while some := list(islice(of_topic, _MOST_TOGETHER)):
            yield some


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
    warn: Callable[[str], None] = lambda text: None,
) -> Replayed:
    """Run a recording, or the journal of a run, and save a run folder.

    Parameters
    ----------
    source : a bag, or a run folder; a run is repeated with exactly its events
    out : the run folder to write
    config : default: the configuration of the run, or of the map, or ``Config()``
    odometry, landmarks : topics, instead of the configured ones
    map_folder : a run whose map is loaded first; the robot's pose in it is unknown until a landmark is recognised
    force : replace a run in ``out``
    progress : wraps the sequence of measurements, for a progress bar; its second argument is their number, or 0
    warn : is told before the work what makes its result meaningless

    Returns
    -------
    The pipeline at its end, with the summary. Where time jumped back and ``time.on_jump`` is reset, the last run is in
    ``out``, and the earlier ones are next to it.

    Raises
    ------
    GraphSlamError
        The source, the map or an input cannot be used.
    """
    took = stopwatch()
    source, out = Path(source), Path(out)
    check_room(out, source, force=force)
    if is_run(source):
        if map_folder is not None:
            raise RunError(f"{source}: a run is repeated in the map that it began in; a map is for a recording")
        return _again(source, out, config, progress, took, force=force)
    map_folder = None if map_folder is None else Path(map_folder)
    losses: list[str] = []
    state = None if map_folder is None else map_of(map_folder, losses)
    if map_folder is not None and state is not None:
        config = config or config_of(map_folder, state)
    config = with_survey(config or Config())
    bag = open_bag(source)
    inputs = choose_inputs(bag, config, odometry, landmarks)
    runs = RecordedRuns(bag, inputs, config, state.datum if state is not None else ())
    bag.losses += losses
    read = iter(runs)
    ahead, end = list(islice(read, _READ_AHEAD)), ((len(runs.counted), [event]) for event in END)
    if found := first_of_replay(runs.columns(), is_whole=len(ahead) < _READ_AHEAD):
        warn(f"the result will mean nothing: {found.code}: {found.text}")
    warmup(dimensions=config.world.dimensions)
    earlier: list[tuple[Path, dict[str, Any]]] = []
    warnings: list[str] = []
    summary: dict[str, Any] = {}
    for number, run in groupby(progress(chain(ahead, read, end), runs.count + len(END)), key=itemgetter(0)):
        if number:
            if (kept := keep_earlier(out, sys.maxsize)) is None:  # none is removed for that
                raise RunError(f"{out}: the run until time jumped back holds nothing")
            earlier.append((kept, summary))
            state, took = None, stopwatch()
        measured = chain.from_iterable(some for _, some in run)
        slam, summary = record_run(
            out,
            config,
            measured,
            bag.losses,
            state,
            border=partial(runs.counted_in, number),
            took=took,
            recording=source.resolve().name,
            more=lambda: _checked(runs, bag),
            force=force,
        )
        warnings += _warnings(slam.view, summary)
    return Replayed(
        slam, summary, summary["losses"], [*bag.warnings, *warnings], tuple(earlier), tuple(inputs.by_topic())
    )


def _again(
    run: Path, out: Path, config: Config | None, progress: Progress, took: Stopwatch, *, force: bool
) -> Replayed:
    """Repeat a run with exactly its events, in the map that it began in."""
    own = run_config(run)
    config = with_survey(config or own)
    if config.world != own.world:
        raise RunError(f"{run}: world.dimensions is {own.world.dimensions} there")
    before = {one.name: one.offset_s for one in own.sources}
    if moved := [one.name for one in config.sources if one.offset_s != before.get(one.name, one.offset_s)]:
        why = f"{run}: a run keeps the stamps that it accepted, so {moved[0]}.offset_s changes nothing"
        raise RunError(f"{why}: replay its recording, or set it for the next drive")
    losses = missing(run)
    state = read_start(run)
    warmup(dimensions=config.world.dimensions)
    measured = progress(read_measurements(run, losses), 0)
    slam, summary = record_run(
        out, config, measured, losses, state, took=took, recording=recording_of(run), force=force
    )
    return Replayed(slam, summary, summary["losses"], _warnings(slam.view, summary))


def _checked(runs: RecordedRuns, bag: Bag) -> dict[str, Any]:
    """The worst finding of the recording so far, from the checks that need no fit."""
    found = worst_of_replay(runs.columns(), is_damaged=bool(bag.losses))
    return {} if found is None else {"check": found.as_dict()}


def _warnings(view: MapView, summary: dict[str, Any]) -> list[str]:
    hidden = {code for one in of_run(summary) for code in one.hides}
    alarms = [] if "displaced" in hidden else [str(one) for one in view.alarms if not is_undecided(asdict(one))]
    return [*doubts(summary), *alarms, *unscaled(summary)]

"""The product of recordings and settings, replayed on all workers into one folder."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from distributed import Client

from graph_slam_ros.config import Config
from graph_slam_ros.config.config import flatten
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.parameters import parse_setting, read_parameters
from graph_slam_ros.tools.fleet.engine import Progress, Workers, connected, fingerprints, run_jobs
from graph_slam_ros.tools.fleet.isolation import run_isolated
from graph_slam_ros.tools.fleet.job import Job
from graph_slam_ros.tools.fleet.recordings import Source, find_sources
from graph_slam_ros.tools.fleet.store import JOBS, REPORT, Row, Store, job_key
from graph_slam_ros.tools.fleet.table import write_table

DEFAULTS = "defaults"


@dataclass(frozen=True, slots=True)
class Fleet:
    """The work of a fleet.

    Attributes
    ----------
    recordings : files, folders, addresses
    out : the folder for the results
    configs : files of parameters; each recording is replayed with each
    settings : ``KEY=VALUE`` or ``KEY=V1,V2``: with each value
    truth : as ``evaluate --truth``, with ``{path}``, ``{folder}`` and ``{stem}`` of the recording; empty without
    limit_s : seconds for a job
    memory : bytes for a job; 0 without limit
    with_report : write a page for each run
    """

    recordings: Sequence[str]
    out: Path
    configs: Sequence[Path] = ()
    settings: Sequence[str] = ()
    truth: str = ""
    limit_s: float = 3600.0
    memory: int = 0
    with_report: bool = False


def settings_of(configs: Sequence[Path], settings: Sequence[str]) -> dict[str, Mapping[str, Any]]:
    """Return the parameters of each configuration by its name: all files with all combinations of settings.

    Raises
    ------
    GraphSlamError
        A file or a setting that cannot be used.
    """
    files: dict[str, dict[str, Any]] = {}
    for file in configs:
        if file.stem in files:
            raise GraphSlamError(f"--config: two files are named {file.stem}: rename one: the table has this name")
        files[file.stem] = dict(flatten(read_parameters(file)))
    choices = []
    for text in settings:
        key, found, values = text.partition("=")
        if not found:
            raise GraphSlamError(f"--set {text}: is not KEY=VALUE")
        choices.append([(f"{key}={value}", parse_setting(f"{key}={value}")) for value in values.split(",")])
    out: dict[str, Mapping[str, Any]] = {}
    for name, values_of_file in (files or {"": {}}).items():
        for chosen in itertools.product(*choices):
            label = " ".join(part for part in (name, *(text for text, _ in chosen)) if part) or DEFAULTS
            try:
                config = Config.from_mapping(values_of_file | dict(pair for _, pair in chosen))
            except GraphSlamError as error:
                raise GraphSlamError(f"{label}: {error}") from None
            out[label] = dict(flatten(config.as_mapping()))
    return out


def truth_of(pattern: str, source: Source) -> str:
    """Return the truth of a recording: the pattern with the recording's ``{path}``, ``{folder}`` and ``{stem}``."""
    path = Path(source.url) if "://" not in source.url else None
    folder, name = (str(path.parent), path.name) if path else source.url.rsplit("/", 1)
    try:
        return pattern.format(path=source.url, folder=folder, stem=name.split(".")[0])
    except (KeyError, IndexError, ValueError):
        raise GraphSlamError(f"--truth {pattern}: knows {{path}}, {{folder}} and {{stem}} of a recording") from None


def jobs_of(fleet: Fleet, sources: Sequence[Source], known: Mapping[str, str]) -> list[Job]:
    """Return the jobs, those of the largest recordings first. A recording without fingerprint has none."""
    out = []
    settings = settings_of(fleet.configs, fleet.settings)
    for source in sources:
        if source.url not in known:
            continue
        truth = truth_of(fleet.truth, source)
        for label, values in settings.items():
            key = job_key(known[source.url], values, truth)
            out.append(
                Job(
                    key,
                    source.url,
                    source.name,
                    label,
                    values,
                    truth,
                    str(fleet.out.absolute()),
                    fleet.limit_s,
                    fleet.memory,
                    fleet.with_report,
                )
            )
    return out


def _lacks_report(store: Store, job: Job, row: Row) -> bool:
    """Return whether a run is to have a report, and has none: it was there before without."""
    return job.with_report and row["state"] != "failed" and not (store.folder / JOBS / job.key / REPORT).is_file()


@dataclass(frozen=True, slots=True)
class Done:
    """The result of a fleet.

    Attributes
    ----------
    rows : of all its jobs
    reused : how many were there before
    unreadable : recordings that could not be read
    unreported : runs that were there and got no report, with the reason
    copies : recordings with the bytes and the truth of another one, which has the row, by their name
    """

    rows: list[Row]
    reused: int
    unreadable: list[str]
    copies: dict[str, str]
    unreported: list[str] = field(default_factory=list)


def replay_all(
    fleet: Fleet,
    workers: Workers,
    progress: Callable[[str], Progress] = lambda _: lambda items, _total: items,
) -> Done:
    """Run all jobs that are not in the folder yet, and write the table.

    Parameters
    ----------
    progress : of a label, wraps a sequence

    Raises
    ------
    GraphSlamError
        Nothing to replay, a setting that cannot be used, or another fleet in the folder.
    """
    settings_of(fleet.configs, fleet.settings)
    sources = find_sources(fleet.recordings)
    for source in sources:
        truth_of(fleet.truth, source)
    store = Store(fleet.out, new=True)
    with store.locked():
        store.forget_attempts()
        with connected(workers) as client:
            known = fingerprints(client, store, sources, progress("hash"))
            every = jobs_of(fleet, sources, known)
            first = {job.key: job for job in reversed(every)}
            jobs = [job for job in every if first[job.key] is job]
            copies = {job.recording: first[job.key].recording for job in every if first[job.key] is not job}
            try:
                by_key, reused = _run_missing(client, store, jobs, progress("replay"))
                bare = [job for job in jobs if _lacks_report(store, job, by_key[job.key])]
                reported = list(run_jobs(client, bare, progress("report"), partial(run_isolated, task="report")))
            finally:
                write_table(store.folder, store.rows())
    unreadable = [one.name for one in sources if one.url not in known]
    unreported = [f"{row['recording']}: {row['reason']}" for row in reported if row["state"] == "failed"]
    return Done(list(by_key.values()), reused, unreadable, copies, unreported)


def _run_missing(client: Client, store: Store, jobs: Sequence[Job], progress: Progress) -> tuple[dict[str, Row], int]:
    """Run the jobs that have no result yet. Return the rows of all by key, and how many were there."""
    by_key = {job.key: job for job in jobs}
    rows = {key: row for key in by_key if (row := store.result(key)) and not row.get("retry")}
    reused, left = len(rows), [job for key, job in by_key.items() if key not in rows]
    store.discard(job.key for job in left)
    rows |= {row["key"]: row for row in run_jobs(client, left, progress)}
    return rows, reused

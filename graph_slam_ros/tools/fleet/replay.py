"""The product of recordings and settings, replayed on all workers into one folder."""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graph_slam_ros.config import Config
from graph_slam_ros.config.config import flatten
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.parameters import parse_setting, read_parameters
from graph_slam_ros.tools.fleet.engine import connected, run_jobs
from graph_slam_ros.tools.fleet.job import Job
from graph_slam_ros.tools.fleet.recordings import Source, find_sources
from graph_slam_ros.tools.fleet.store import JOBS, REPORT, Row, Store, job_key, write_table

DEFAULTS = "defaults"
Progress = Callable[[Iterable[Any], int], Iterable[Any]]


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
    """Return the parameters of each configuration by its name: all files with all combinations of settings."""
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


def jobs_of(fleet: Fleet) -> list[Job]:
    """Return the jobs, those of the largest recordings first.

    Raises GraphSlamError: nothing to replay, or a setting or a truth that cannot be used.
    """
    settings, out = settings_of(fleet.configs, fleet.settings), str(fleet.out.absolute())
    return [
        Job(
            job_key(source.identity, values, truth),
            *(source.url, source.name, label, values, truth, out),
            *(fleet.limit_s, fleet.memory, fleet.with_report),
        )
        for source in find_sources(fleet.recordings)
        for truth in (truth_of(fleet.truth, source),)
        for label, values in settings.items()
    ]


def replay_all(
    fleet: Fleet, scheduler: str = "", workers: int = 0, progress: Progress = lambda items, _: items
) -> tuple[list[Row], int]:
    """Run all jobs that are not in the folder yet, and write the table.

    Parameters
    ----------
    scheduler, workers : of Dask, as ``connected`` takes them

    Returns
    -------
    the rows of all its jobs, and how many were there before

    Raises
    ------
    GraphSlamError
        Nothing to replay, a setting that cannot be used, or another fleet in the folder.
    """
    jobs = jobs_of(fleet)
    store = Store(fleet.out, new=True)
    with store.locked():
        rows = {job.key: row for job in jobs if (row := store.result(job.key)) and _is_whole(store, job, row)}
        reused, left = len(rows), [job for job in jobs if job.key not in rows]
        store.clear(job.key for job in left)
        try:
            if left:
                with connected(scheduler, workers) as client:
                    rows |= {row["key"]: row for row in progress(run_jobs(client, left), len(left))}
        finally:
            write_table(store.folder, list(store.rows()))
    return list(rows.values()), reused


def _is_whole(store: Store, job: Job, row: Row) -> bool:
    """Return whether nothing is to be added to a run that is there: a machine failed, or it is to have a report."""
    has_report = (store.folder / JOBS / job.key / REPORT).is_file()
    return not row.get("retry") and (has_report or not job.with_report or row["state"] == "failed")

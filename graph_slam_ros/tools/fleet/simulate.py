"""Sweeps of simulated worlds: the product of worlds, options, faults, seeds and settings, scored by their own truth."""

import hashlib
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.parameters import parse_setting
from graph_slam_ros.tools.fleet.engine import Progress, Workers, connected
from graph_slam_ros.tools.fleet.job import Job
from graph_slam_ros.tools.fleet.replay import Done, run_missing, settings_of
from graph_slam_ros.tools.fleet.store import Row, Store, job_key
from graph_slam_ros.tools.fleet.table import write_table
from graph_slam_ros.tools.fleet.worlds import NO_FAULT, address, world_of
from graph_slam_ros.tools.simulation import Fault, check_options

_SELF = "its own"


@dataclass(frozen=True, slots=True)
class Sweep:
    """The work of a sweep.

    Attributes
    ----------
    worlds : names
    out, configs, limit_s, memory : as of ``Fleet``
    seeds, first : so many drives of each, from which seed on
    faults : as of ``simulate --fault``; each is put into a drive by itself, and there is one without
    settings : ``KEY=V1,V2``: with a dot a parameter, without one an option of the worlds
    """

    worlds: Sequence[str]
    out: Path
    seeds: int = 10
    first: int = 0
    faults: Sequence[str] = ()
    configs: Sequence[Path] = ()
    settings: Sequence[str] = ()
    limit_s: float = 3600.0
    memory: int = 0


def jobs_of(sweep: Sweep) -> list[Job]:
    """Return the jobs, seed by seed.

    Raises
    ------
    GraphSlamError
        A world, an option, a fault or a setting that does not exist.
    """
    of_parameters = [text for text in sweep.settings if "." in text.partition("=")[0]]
    worlds = list(_worlds(sweep.worlds, [text for text in sweep.settings if text not in of_parameters]))
    for fault in sweep.faults:
        Fault.parsed(fault)
    settings, out = settings_of(sweep.configs, of_parameters), []
    seeds = range(sweep.first, sweep.first + sweep.seeds)
    for seed, (world, options), fault in itertools.product(seeds, worlds, (NO_FAULT, *sweep.faults)):
        url = address(world, options, fault, seed)
        about = world_of(url)
        name = f"{about['world']}{'' if fault == NO_FAULT else f' {fault}'} seed {seed}"
        for label, values in settings.items():
            out.append(
                Job(
                    key=job_key(hashlib.sha256(url.encode()).hexdigest(), values, _SELF),
                    url=url,
                    recording=name,
                    setting=label,
                    values=values,
                    truth=_SELF,
                    out=str(sweep.out.absolute()),
                    limit_s=sweep.limit_s,
                    memory=sweep.memory,
                    with_report=False,
                )
            )
    return out


def _worlds(names: Sequence[str], settings: Sequence[str]) -> Iterable[tuple[str, Mapping[str, Any]]]:
    """Each world with each combination of options."""
    choices = []
    for text in settings:
        key, found, values = text.partition("=")
        if not found:
            raise GraphSlamError(f"--set {text}: is not KEY=VALUE")
        choices.append([parse_setting(f"{key}={value}") for value in values.split(",")])
    for name, options in itertools.product(names, itertools.product(*choices)):
        check_options(name, 0, dict(options))
        yield name, dict(options)


def simulate_all(
    sweep: Sweep,
    workers: Workers,
    progress: Callable[[str], Progress] = lambda _: lambda items, _total: items,
    on_start: Callable[[str], None] = lambda _: None,
) -> Done:
    """Simulate, replay and score all that is not in the folder yet, and write the table.

    Raises
    ------
    GraphSlamError
        As ``jobs_of``; or another fleet in the folder.
    """
    jobs = jobs_of(sweep)
    store = Store(sweep.out, new=True)
    with store.locked():
        store.forget_attempts()
        with connected(workers) as client:
            on_start(client.dashboard_link)
            try:
                by_key, reused = run_missing(client, store, jobs, progress("simulate"))
            finally:
                write_table(store.folder, store.rows())
    return Done([by_key[job.key] for job in jobs], reused, [], {})


@dataclass(frozen=True, slots=True)
class Cell:
    """The drives of a world with a fault and a setting.

    Attributes
    ----------
    runs, failed : drives, and those of them without a result
    rmse_m, worst_m : mean and greatest error of the path; NaN without any
    map_rmse_m : mean error of the landmarks
    nees, nees_sigma : mean over drives, and its standard error
    """

    world: str
    fault: str
    setting: str
    runs: int
    failed: int
    rmse_m: float
    worst_m: float
    map_rmse_m: float
    nees: float
    nees_sigma: float


def cells(rows: Iterable[Row]) -> list[Cell]:
    """Return the means over seeds, in order of world, fault and setting."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["world"], row["fault"], row["setting"]), []).append(row)
    return [_cell(key, groups[key]) for key in sorted(groups, key=lambda k: (k[0], k[1] != NO_FAULT, k[1:]))]


def _cell(key: tuple[str, str, str], rows: Sequence[Row]) -> Cell:
    def of(name: str) -> "np.ndarray[Any, np.dtype[np.float64]]":
        return np.array([row[name] for row in rows if row.get(name) is not None], dtype=np.float64)

    rmse, nees = of("rmse_m"), of("nees")
    return Cell(
        *key,
        runs=len(rows),
        failed=sum(row["state"] == "failed" for row in rows),
        rmse_m=_mean(rmse),
        worst_m=float(rmse.max()) if len(rmse) else float("nan"),
        map_rmse_m=_mean(of("map_rmse_m")),
        nees=_mean(nees),
        nees_sigma=float(nees.std(ddof=1) / len(nees) ** 0.5) if len(nees) > 1 else float("nan"),
    )


def _mean(values: "np.ndarray[Any, np.dtype[np.float64]]") -> float:
    return float(values.mean()) if len(values) else float("nan")

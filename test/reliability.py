"""How often what may fail was tried, and failed, told at the end of a session; ``make soak`` tries more."""

import json
import os
import time
from collections import Counter, defaultdict
from pathlib import Path

_TOLD = defaultdict(Counter)
_WORST = defaultdict(dict)


def times(quick, long):
    """How often to try: so often in ``make test``, and in ``make soak``."""
    return long if os.environ.get("GRAPH_SLAM_SOAK") else quick


def tell(name, *, worst=None, **numbers):
    """Add to the numbers of a line; of ``worst`` the largest is told.

    What cannot go to another process fails here, in its test: at the end of a session it would end the session.
    """
    _TOLD[name].update(_plain(numbers))
    for key, number in _plain(worst or {}).items():
        _WORST[name][key] = max(number, _WORST[name].get(key, number))


def _plain(numbers):
    """The same without types of NumPy."""
    return json.loads(json.dumps(numbers, default=lambda number: number.item()))


def told():
    """All of it, for another process."""
    return [(name, dict(numbers), dict(_WORST[name])) for name, numbers in _TOLD.items()]


def add(others):
    """What another process was told."""
    for name, numbers, worst in others:
        tell(name, worst=worst, **numbers)


def lines():
    """What was told."""
    for name, numbers in _TOLD.items():
        worst = [f"worst_{key}={value:.3g}" for key, value in _WORST[name].items()]
        yield " ".join(["RELIABILITY", name, *(f"{key}={number}" for key, number in numbers.items()), *worst])


def calm_s():
    """A clock for limits of time: it hardly goes on while a process of this machine waits for a processor."""
    pressure = Path("/proc/pressure/cpu")
    waited_us = int(pressure.read_text().split("total=")[1].split()[0]) if pressure.exists() else 0
    return time.monotonic() - 0.9e-6 * waited_us

"""How often what may fail was tried, and how often it failed: told at the end of a session, a line for each test.

``make soak`` tries more (``GRAPH_SLAM_SOAK``).
"""

import os
from collections import Counter, defaultdict

_TOLD = defaultdict(Counter)
_WORST = defaultdict(dict)


def times(quick, long):
    """How often to try: so often in ``make test``, and in ``make soak``."""
    return long if os.environ.get("GRAPH_SLAM_SOAK") else quick


def tell(name, *, worst=None, **numbers):
    """Add to the numbers of a line; of ``worst`` the largest is told."""
    _TOLD[name].update({key: number.item() if hasattr(number, "item") else number for key, number in numbers.items()})
    for key, value in (worst or {}).items():
        number = float(value)  # numbers of NumPy could not go to another process
        _WORST[name][key] = max(number, _WORST[name].get(key, number))


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

"""Limits of time for tests: those of an idle machine, and longer ones where it is busy."""

import os


def lenient(seconds):
    """So many, or as many more as the machine has more to do than it can."""
    return seconds * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))

"""Listeners to the progress of long work; light to import."""

from collections.abc import Callable

listeners: list[Callable[[str], None]] = []
"""Called several times a second while kernels are compiled, with a sentence of progress."""


def report(message: object) -> None:
    """Call all listeners."""
    for listener in listeners:
        listener(str(message))

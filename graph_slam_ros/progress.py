"""Who is told how far something is that takes long; light to import."""

from collections.abc import Callable

listeners: list[Callable[[str], None]] = []
"""Called several times a second while kernels are compiled, with the words for it."""


def report(said: str) -> None:
    """Tell all listeners."""
    for listener in listeners:
        listener(said)

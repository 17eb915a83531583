"""Colours of all pictures, of the report and of RViz: the same thing has the same colour everywhere.

Truth is blue, dead reckoning black (white on a dark page), the estimate red; landmarks are amber stars, closures plum.
A test simulates colour blindness of three kinds: every two of them, and the paper, stay apart.
"""

LIGHT = {
    "truth": "#1f6fd6",
    "odometry": "#1a1a1a",
    "estimate": "#d62728",
    "landmarks": "#f0a202",
    "closures": "#804075",
    "paper": "#ffffff",
}
"""On white paper."""
DARK = {
    "truth": "#6cb2ff",
    "odometry": "#ffffff",
    "estimate": "#ff5c5c",
    "landmarks": "#ffc933",
    "closures": "#a6537c",
    "paper": "#16191d",
}
"""On a dark page."""
QUIET = "#9aa0a6"
"""Things in the background: drives before."""


def rgba(colour: str, alpha: float) -> tuple[float, float, float, float]:
    """A colour as numbers from 0 to 1, as messages have it."""
    red, green, blue = (int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5))
    return red, green, blue, alpha

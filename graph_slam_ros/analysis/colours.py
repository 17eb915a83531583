"""Colours of all pictures and of the report: the same thing has the same colour everywhere.

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

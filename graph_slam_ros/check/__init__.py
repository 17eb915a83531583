"""Checks of a recording: what is wrong with it, by how much, and what mends it."""

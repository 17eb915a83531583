"""Landmarks without ids: which one is seen, now and with hindsight."""

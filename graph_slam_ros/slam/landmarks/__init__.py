"""Landmarks from observations: their map, triangulation, lifetimes."""

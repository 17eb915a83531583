"""Landmarks from observations: triangulation, data association, landmarks with and without ids."""

"""From observations to landmarks: triangulation, data association, landmarks with and without ids."""

"""The run folder: everything a run leaves behind, written the same way by the node and by replay.

``graph.g2o`` and ``graph_vertices.csv`` (stamp and name of each vertex), ``ledger.csv`` and ``ledger_changes.csv``
(each edge, what is believed of it, and how that came: ``ledger_file``), ``path.tum`` and ``path_odometry.tum``
(estimate and dead reckoning at keyframes), ``covariances.csv``, ``sightings.tum`` and ``odometry.tum`` (the same two at
sightings), ``landmarks.csv``, ``path.png``, ``run.mcap``, ``ingest.mcap`` (the journal), ``map.mcap`` (the
newest map: ``map_file``), ``config.yaml``, ``run.json``.

Covariances are written as their upper triangle, row by row. Those of ``covariances.csv``, of each pose of ``path.tum``,
are in the pose's tangent space, with (x, y, theta) or (x, y, z, rotation vector) along and about the axes of the robot;
those of ``landmarks.csv`` are in the axes of map. What is not known is nan; what a point does not have is empty.
"""

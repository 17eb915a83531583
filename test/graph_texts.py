"""Two small g2o files, in the plane and in space."""

import numpy as np

PLANE = """\
VERTEX_SE2 10 0.1 -2e-07 3
VERTEX_SE2 11 1.5 -0.002 0.25
VERTEX_XY 7 3 4
EDGE_SE2 10 11 1 0 0.1 10 1 -2 20 3 30
EDGE_SE2_XY 11 7 1 2 4 1 9
"""
UPPER = " ".join(str(float(v)) for v in (np.eye(6) * [1, 2, 3, 4, 5, 6] + 0.25)[np.triu_indices(6)])
SPACE = f"""\
VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 2 3 0.1 -0.7 0.1 0.7
EDGE_SE3:QUAT 0 1 1 2 3 0.5 0.5 -0.5 0.5 {UPPER}
"""

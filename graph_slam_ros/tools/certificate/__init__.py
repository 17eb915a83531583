"""The certificate that an estimate is the global optimum: SE-Sync's dual certificate for graphs of relative poses.

* ``synchronization``: the problem it is about, which is chordal and isotropic,
* ``spectrum``: from the solver's estimate to a critical point of that problem, and the smallest eigenvalue of the
  certificate matrix there,
* ``certify``: when it applies, what it says, and how far the two optima are apart.

D. M. Rosen, L. Carlone, A. S. Bandeira, J. J. Leonard, "SE-Sync: a certifiably correct algorithm for synchronization
over the special Euclidean group", IJRR 38(2-3), 2019; L. Carlone, D. M. Rosen, G. Calafiore, J. J. Leonard,
F. Dellaert, "Lagrangian duality in 3D SLAM: verification techniques and optimal solutions", IROS 2015; L. Carlone,
G. Calafiore, C. Tommolillo, F. Dellaert, "Planar pose graph optimization: duality, optimal solutions, and
verification", IEEE T-RO 32(3), 2016.
"""

from graph_slam_ros.tools.certificate.certify import CERTIFIED, DOES_NOT_APPLY, NOT_CERTIFIED, Certificate, certify

__all__ = ["CERTIFIED", "DOES_NOT_APPLY", "NOT_CERTIFIED", "Certificate", "certify"]

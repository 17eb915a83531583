"""Lie groups and THE conventions of this package, stated once.

* A pose ``T_a_b`` maps coordinates of frame b into frame a: ``p_a = T_a_b p_b``, ``T_a_c = T_a_b T_b_c``.
* Tangent vectors are ordered (translation, rotation), as ROS covariances and g2o order them.
* Perturbations act on the right: ``T [+] d = T Exp(d)`` and ``A [-] B = Log(B^-1 A)``; so a covariance belongs to the
  body frame of its pose.
* Angles are wrapped to [-pi, pi) where they are compared, nowhere else.
* Metres and radians.
"""

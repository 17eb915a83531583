"""Numbers that several policies share: each has one home, and what follows from it is derived where it is used."""

from graph_slam_ros.config.pipeline import RobustConfig

GATE = RobustConfig().gate  # quantile of chi2: what is beyond does not fit, whatever gate is configured
BY_CHANCE = 1e-6  # probability of an alarm in a drive of clean measurements, and of a slip before anything is seen
SAME_M, SAME_RAD = 1.0, 0.3  # poses farther from each other are two
PRIOR_DOF = 20.0  # degrees of freedom that fit, which noise as stated counts as before any was measured
DIGITS = 12  # of a number that is stored: the last ones of a sine depend on the machine

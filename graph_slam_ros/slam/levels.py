"""Numbers that several policies share: each has one home, and what follows from it is derived where it is used."""

from graph_slam_ros.config.pipeline import RobustConfig

GATE = RobustConfig().gate  # quantile of chi2: what is beyond does not fit, whatever gate is configured
LIKELY = 0.999  # probability with which a true one passes, where many are tried
BY_CHANCE = 1e-6  # probability of an alarm in a drive of clean measurements, and of a slip before anything is seen
SAME_M, SAME_RAD = 1.0, 0.3  # poses farther from each other are two
ENOUGH = 3  # landmarks, or measurements: two may agree by chance
TYPICAL = 30  # residuals tell what all are like
SIGMAS = 4.0  # 1 in 16,000 by chance
PRIOR_DOF = 20.0  # degrees of freedom that fit, which noise as stated counts as before any was measured
GROWN = 1.5  # times as many as the last time: what looks at all of them is done again
ROUNDING = 1e-9  # m, rad, s, or part: less is rounding
SINGULAR = 1e-6  # eigenvalue, degrees of freedom, or part of chi2: less is rounding of what was solved
DIGITS = 12  # of a number that is stored: the last ones of a sine depend on the machine

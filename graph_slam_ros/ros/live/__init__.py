"""The parts of the running node: what it hears, the thread that solves, what it tells, how it is."""

"""A function in a child process with little memory: what a file says of its size must not be believed."""

import multiprocessing
import resource
from concurrent.futures import ProcessPoolExecutor

MIB = 2**20


def confined(function, *arguments, mib=256, patience_s=60.0):
    """What a function returns that may take so much more memory than this process has; raises what it raises."""
    pool = ProcessPoolExecutor(1, multiprocessing.get_context("fork"), _confine, (mib * MIB,))
    with pool:
        return pool.submit(function, *arguments).result(patience_s)


def _confine(more):
    with open("/proc/self/statm") as file:
        now = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + more, now + more))

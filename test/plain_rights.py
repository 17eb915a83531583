"""To be refused what a user is refused (root may read and write everything, whatever its mode says), and how."""

import contextlib
import ctypes
import io
import os

from graph_slam_ros import cli

_OVERRIDE = 1 << 1 | 1 << 2  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
_VERSION = 0x20080522


class _Head(ctypes.Structure):
    _fields_ = (("version", ctypes.c_uint32), ("pid", ctypes.c_int))


class _Sets(ctypes.Structure):
    _fields_ = (("effective", ctypes.c_uint32), ("permitted", ctypes.c_uint32), ("inheritable", ctypes.c_uint32))


@contextlib.contextmanager
def plain_rights():
    """Modes of files hold for this thread, also where it is root's."""
    if os.geteuid() != 0:
        yield
        return
    libc = ctypes.CDLL(None, use_errno=True)
    head, sets = _Head(_VERSION, 0), (_Sets * 2)()
    assert libc.capget(ctypes.byref(head), sets) == 0, os.strerror(ctypes.get_errno())
    before = sets[0].effective
    try:
        sets[0].effective = before & ~_OVERRIDE
        assert libc.capset(ctypes.byref(head), sets) == 0, os.strerror(ctypes.get_errno())
        yield
    finally:
        sets[0].effective = before
        assert libc.capset(ctypes.byref(head), sets) == 0, os.strerror(ctypes.get_errno())


def answer(*words):
    """Exit code and the lines on standard error of a command, in this process."""
    err = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        try:
            code = cli.main([str(word) for word in words])
        except SystemExit as end:
            code = end.code
    return code, err.getvalue().splitlines()

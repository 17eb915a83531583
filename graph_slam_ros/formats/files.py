"""The one way to open a file: only regular files are opened, and opening never blocks.

A FIFO without a writer would block for ever, a device may never end, and a sparse file of a terabyte would take all
memory. In a run folder no symbolic link is followed, since a link may lead to any file of the user. A recording or a
graph that the user names may be a link (``follow``).
"""

import errno
import io
import os
import stat
from pathlib import Path

_READ = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC
_FREE, _MOST_RATIO = 2**20, 1000  # bytes that may be a hole, and how often a longer file may be what is on the disk
_CREATE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


class _Regular(io.FileIO):
    """Refuses kernel files that claim to be regular, and block on reading."""

    def read(self, size: int | None = -1, /) -> bytes:
        found: bytes | None = super().read(-1 if size is None else size)
        if found is None:
            raise OSError(errno.EAGAIN, "nothing to read: reading it would block", self.name)
        return found


def opened(path: Path, *, follow: bool = False) -> io.FileIO:
    """Open a regular file to read its bytes.

    Raises
    ------
    OSError
        There is no such file, it cannot be read, it is not a regular file, it is little but holes, or it is a link that
        is not to be followed.
    """
    return _Regular(path, opener=_follow if follow else _no_follow)


def read_bytes(path: Path, *, follow: bool = False) -> bytes:
    """The whole content. Raises OSError as ``opened``."""
    with opened(path, follow=follow) as stream:
        return stream.read()


def read_text(path: Path, *, follow: bool = False) -> str:
    """The whole content as UTF-8. Raises OSError as ``opened``, and UnicodeDecodeError."""
    return read_bytes(path, follow=follow).decode()


def is_regular(path: Path) -> bool:
    """Return whether a regular file has this name; a link to one does not count."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except OSError:
        return False


def is_empty(path: Path) -> bool:
    """Return whether there is nothing to read: no such file, or a regular one without bytes.

    A FIFO or a link is not empty, nor is a file that cannot be inspected: opening it raises the reason.
    """
    try:
        there = path.lstat()
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return stat.S_ISREG(there.st_mode) and there.st_size == 0


def created(path: Path) -> int:
    """Create a file that does not exist yet; returns its descriptor. Raises OSError, also if a link has the name."""
    return os.open(path, _CREATE, 0o644)


def _follow(path: str, _: int) -> int:
    return _checked(os.open(path, _READ), path)


def _no_follow(path: str, _: int) -> int:
    try:
        return _checked(os.open(path, _READ | os.O_NOFOLLOW), path)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(error.errno, "a symbolic link, which is not followed here", path) from None
        raise


def _checked(fd: int, path: str) -> int:
    about = os.fstat(fd)
    on_disk = 512 * about.st_blocks
    if not stat.S_ISREG(about.st_mode):
        what = "a folder" if stat.S_ISDIR(about.st_mode) else "a FIFO, socket or device"
        fault = f"{what}, not a regular file"
    elif about.st_size > max(_FREE, _MOST_RATIO * on_disk):
        fault = f"a sparse file: {about.st_size} bytes long, of which {on_disk} are on the disk; not read"
    else:
        return fd
    os.close(fd)
    raise OSError(errno.EINVAL, fault, path)

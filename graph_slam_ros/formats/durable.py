"""Files that survive a crash: one that only grows, and one that is replaced as a whole.

A file is always created under a new name, so that no link is followed.
"""

import contextlib
import errno
import fcntl
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path

from graph_slam_ros.formats.files import created


class AppendedFile:
    """A new file that only grows. What cannot be written is kept, and written the next time.

    Flushed data survive the process, synced data a power cut. There are no holes: a process that dies while writing
    leaves the first part of its data. The first flush creates the file; an existing name is refused.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._fd = _NOT_MADE
        self._is_named = False  # on the disk
        self._end = 0
        self._unwritten = bytearray()

    def write(self, data: bytes) -> int:
        """Append data. It is in the file after the next flush."""
        self._unwritten += data
        return len(data)

    def tell(self) -> int:
        """Return the position of the next byte, as ``io.IOBase.tell`` does."""
        return self._end + len(self._unwritten)

    @property
    def unwritten(self) -> int:
        """The number of bytes that are not in the file yet."""
        return len(self._unwritten)

    def flush(self) -> None:
        """Write what is kept in memory. Raises OSError; then some of it is still kept."""
        if self._fd == _NOT_MADE:
            self._fd = created(self._path)
        if not self._is_named and self._fd >= 0:
            sync_folder(self._path.parent)
            self._is_named = True
        while self._unwritten:
            written = os.pwrite(self._fd, self._unwritten, self._end)
            self._end += written
            del self._unwritten[:written]

    def sync(self) -> None:
        """Sync what was flushed, if anything was. It may be called from another thread. Raises OSError."""
        if (fd := self._fd) >= 0:
            os.fsync(fd)

    def close(self) -> None:
        """Flush, sync and close. After an OSError the file is still open, and may be closed again."""
        if self._fd != _CLOSED:
            self.flush()
            self.sync()
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is on the disk. What is in memory is lost."""
        fd, self._fd = self._fd, _CLOSED
        if fd >= 0:
            os.close(fd)


_NOT_MADE, _CLOSED = -1, -2


@contextlib.contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """The name of a new file that replaces an old one; a reader always sees the old file or the new one.

    A link of that name is replaced itself, not its target.

    Raises
    ------
    OSError
        What has the name is neither a regular file nor a link, or the file cannot be written.
    """
    with contextlib.suppress(FileNotFoundError):
        mode = path.lstat().st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):
            raise FileExistsError(errno.EEXIST, "not a regular file, and so not replaced", str(path))
    new = path.with_name(f".{secrets.token_hex(4)}{NEW}")
    try:
        yield new
        fd = os.open(new, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)
        os.replace(new, path)
    except BaseException as error:  # an interrupt, too, leaves nothing behind
        new.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(new)):  # who reads it knows the other name
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise
    sync_folder(path.parent)


def write_whole(path: Path, data: bytes) -> None:
    """Write a file completely or not at all. Raises OSError as ``replaced``."""
    with replaced(path) as new:
        file = AppendedFile(new)
        file.write(data)
        try:
            file.flush()
        finally:
            file.abandon()


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Lock a folder against others that lock it, until the end of the block or of the process.

    Raises
    ------
    BlockingIOError
        Somebody else has it, or it was replaced by another of its name just now.
    """
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        if not (_locked(fd) and os.path.samestat(os.fstat(fd), folder.stat())):
            raise BlockingIOError(errno.EWOULDBLOCK, "another process records there")
        yield
    finally:
        os.close(fd)


def _locked(fd: int) -> bool:
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:  # a file system may have no locks, or none for folders
        return not isinstance(error, BlockingIOError)
    return True


def sync_folder(folder: Path) -> None:
    """Sync the names that were created or changed in a folder."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


NEW = ".new"
"""The name of a file that is still being written is a dot, eight hexadecimal digits, and this."""

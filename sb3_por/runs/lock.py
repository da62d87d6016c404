"""Locks of folders that one process at a time may write to."""

import errno
import warnings
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

from sb3_por.common.errors import UserError, UserNote
from sb3_por.runs.folder import LOCK


def lock_folder(folder: Path, in_use: str) -> BaseFileLock:
    """
    Take the lock of a folder until it is released or the process ends; the system frees the lock of a killed process.

    Some network file systems have no locks. A note tells then that nothing keeps a second process away.

    :param folder: Folder of a run, or of a suite
    :param in_use: Message if another process holds the lock
    :return: The lock, to be released
    :raises UserError: If another process holds the lock, or the folder cannot be written
    """
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise UserError(in_use) from error
    except OSError as error:
        if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOSPC, errno.EDQUOT):
            raise UserError(f"cannot write in {folder}: {error.strerror}; give another folder") from error
        warnings.warn(
            f"the file system of {folder} has no locks ({error.strerror}): see to it that no second process writes there",
            UserNote,
        )
    return lock


def is_locked(folder: Path) -> bool:
    """Whether a process holds the lock of a folder, as far as can be told: on this machine, where there are locks."""
    file = folder / LOCK
    if not file.is_file():
        return False
    try:
        with FileLock(file, timeout=0):
            return False
    except Timeout:
        return True
    except OSError:  # a folder that can only be read, or a file system without locks
        return False

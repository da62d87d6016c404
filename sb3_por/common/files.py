"""Atomic writes, disks that cannot be written, and checks of output paths."""

import errno
import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sb3_por.common.errors import UserError

#: Errors of a disk, as opposed to those of a program: full, over its quota, read-only, damaged, or out of reach
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ESTALE)
#: Bytes that a disk with room takes
PROBE_SIZE = 2**18


class DiskError(UserError):
    """A file could not be written because its disk is full, read-only or out of reach. What was there before is unchanged."""


@contextmanager
def disk_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """
    A context that writes to a path. Libraries hide the reason for which a write failed (NumPy's error has no ``errno``,
    PyTorch's is a ``RuntimeError``), so the folder is tried again after any error.

    :param path: File or folder, for the message
    :raises DiskError: Instead of another error if the disk is the reason
    """
    try:
        yield
    except DiskError:
        raise
    except Exception as error:
        code = getattr(error, "errno", None)
        if code not in DISK_ERRORS:
            code = _try_to_write(Path(path).parent)
        if code is None:
            raise
        hint = "; free some space" if code in (errno.ENOSPC, errno.EDQUOT) else ""
        raise DiskError(f"cannot write {path}: {os.strerror(code)}{hint}") from error


def _try_to_write(folder: Path) -> int | None:
    """
    :return: One of ``DISK_ERRORS`` if the disk of a folder cannot be written
    """
    probe = folder / f".{uuid.uuid4().hex}"
    try:
        with open(probe, "wb", buffering=0) as file:
            if file.write(b"\0" * PROBE_SIZE) < PROBE_SIZE:
                return errno.ENOSPC
            os.fsync(file.fileno())
    except OSError as error:
        return error.errno if error.errno in DISK_ERRORS else None
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
    return None


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """
    Replace a file atomically: the body writes a temporary file beside it, which is renamed when the body ends without an
    error. A killed process and a full disk leave the old file or the new one.

    :param path: File to replace; the temporary one keeps its suffix, on which SB3, NumPy and Matplotlib depend
    :return: Temporary path to write to
    :raises DiskError: If the disk is full, read-only or out of reach
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex}{path.suffix}")
    try:
        with disk_errors(path):
            yield temporary
            with open(temporary, "rb") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove_unfinished(folder: str | os.PathLike[str]) -> None:
    """Remove temporary files of killed processes at any depth of a folder that no other process writes to."""
    for path in Path(folder).rglob(".*"):
        if path.is_file() and re.fullmatch(r"\..+\.[0-9a-f]{32}(\.\w+)?", path.name):
            path.unlink()


def check_writable(folder: str | os.PathLike[str]) -> None:
    """
    Make a folder and try to write in it.

    :raises UserError: If that is not possible
    """
    probe = Path(folder) / f".{uuid.uuid4().hex}"
    try:
        probe.parent.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise UserError(f"cannot write in {folder}: {error.strerror}; give another folder") from error


def check_output(path: str | os.PathLike[str], suffixes: tuple[str, ...]) -> Path:
    """
    :param path: the file to be written
    :param suffixes: the formats there are, in lower case with the dot
    :raises UserError: if the suffix is another or the folder cannot be written
    """
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise UserError(f"{path} must end in {' or '.join(suffixes)}")
    check_writable(path.parent)
    return path

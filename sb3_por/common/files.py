"""Atomic writes, and checks of output paths."""

import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sb3_por.common.errors import UserError


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """
    Replace a file atomically: the body writes a temporary file beside it, which is renamed when the body ends without an
    error. A killed process leaves the old file or the new one.

    :param path: File to replace; the temporary one keeps its suffix, on which SB3, NumPy and Matplotlib depend
    :return: Temporary path to write to
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex}{path.suffix}")
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
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

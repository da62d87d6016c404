"""Files that are whole or absent, and folders that can be written."""

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
    A context whose body writes a temporary file beside ``path``; the file appears under its name when the body ends
    without an error, so that a killed process leaves the old file or the new one, never half of one.

    :param path: the file to replace; its suffix is kept, since SB3, NumPy and Matplotlib go by it
    :return: the temporary path to write to
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
    """Remove what a process that was killed inside ``atomic_write`` left at any depth of a folder where no other writes."""
    for path in Path(folder).rglob(".*"):
        if path.is_file() and re.fullmatch(r"\..+\.[0-9a-f]{32}(\.\w+)?", path.name):
            path.unlink()


def check_writable(folder: str | os.PathLike[str]) -> None:
    """
    Make a folder and try to write in it, before hours of work are to be stored there.

    :raises UserError: if that is not possible
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

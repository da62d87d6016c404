"""Disks that are full or read-only, for real: a small tmpfs, where the system lets us mount one."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def small_disk(folder: Path, megabytes: float = 2.0) -> Iterator[Path]:
    """
    A disk with little room in a folder. Skips the test where mounting is not allowed.

    :param folder: Where to mount it
    :param megabytes: Its size
    """
    folder.mkdir(parents=True, exist_ok=True)
    size = f"size={round(megabytes * 1024)}k"
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(folder)], capture_output=True, text=True)
    if mounted.returncode != 0:
        pytest.skip(f"a small disk cannot be mounted: {mounted.stderr.strip()}")
    try:
        yield folder
    finally:
        while folder.is_mount():
            subprocess.run(["umount", "--lazy", str(folder)], check=True)


def make_read_only(folder: Path) -> None:
    """Make a mounted disk read-only, as a system does after an error: also while files on it are open for writing."""
    subprocess.run(["mount", "--bind", str(folder), str(folder)], check=True)
    subprocess.run(["mount", "-o", "remount,bind,ro", str(folder)], check=True)


def fill(folder: Path, left: int = 0) -> Path:
    """
    Fill a disk.

    :param folder: A folder on it
    :param left: Bytes to leave, to the next 4 KiB
    :return: The file to remove to make room again
    """
    filling = folder / "filling"
    with open(filling, "wb", buffering=0) as file:
        try:
            while file.write(b"0" * 4096) == 4096:
                pass
        except OSError:
            pass
        if left:
            file.truncate(max(file.tell() - left, 0))
    return filling

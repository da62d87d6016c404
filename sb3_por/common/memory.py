"""Memory that a process may still take: of the machine, or of the container that it runs in."""

from collections.abc import Iterator
from pathlib import Path

import psutil


def available_memory(root: Path = Path("/")) -> int:
    """
    :param root: Root of the file system that describes the process's control groups (Linux)
    :return: Bytes that this process can take before the machine is out of memory, or before a control group above it (version
        1 or 2; what limits a container, a Slurm job or a systemd unit) is at its limit and processes are killed
    """
    return min([psutil.virtual_memory().available, *_left_in_groups(root)])


def _left_in_groups(root: Path) -> Iterator[int]:
    """Bytes left in each control group of this process that has a limit; the kernel's page cache does not count as used."""
    for folder, (limit_file, usage_file, cache) in _groups(root):
        try:
            limit = int((folder / limit_file).read_text())
            used = int((folder / usage_file).read_text())
            statistics = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        except (OSError, ValueError):  # no such group, or "max": no limit
            continue
        yield max(limit - used + int(statistics.get(cache, 0)), 0)


def _groups(root: Path) -> Iterator[tuple[Path, tuple[str, str, str]]]:
    """Folders of this process's control groups up to the topmost, with the names of limit, usage and reclaimable cache."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        number, controllers, path = line.split(":", 2)
        if number == "0":
            mount, names = root / "sys/fs/cgroup", ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            mount = root / "sys/fs/cgroup/memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        # Inside a container the path may be that of the host, and the container's own group is mounted at the top.
        group = Path(path.lstrip("/"))
        for part in (group, *group.parents):
            yield mount / part, names

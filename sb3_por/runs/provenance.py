"""Provenance of a run: the commit and the machine that it was started on."""

import os
import platform
import re
import subprocess
from pathlib import Path

import psutil
import torch as th


def current_commit() -> str:
    """The commit of the checkout that this package runs from, ``+`` if files differ from it; empty without one."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return ""
    git = ["git", "-C", str(root)]
    try:
        commit = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True)
        changed = subprocess.run([*git, "status", "--porcelain", "-uno"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return commit.stdout.strip() + ("+" if changed.stdout.strip() else "")


def current_machine() -> str:
    """One line about the machine of this process: processor, accelerator, memory, versions."""
    info = Path("/proc/cpuinfo")
    models = re.findall(r"model name\s*:\s*(.+)", info.read_text()) if info.is_file() else []
    parts = [
        f"{len(os.sched_getaffinity(0))} cores of {models[0].strip() if models else platform.machine()}",
        *([th.cuda.get_device_name()] if th.cuda.is_available() else []),
        f"{psutil.virtual_memory().total / 2**30:.0f} GiB",
        platform.system(),
        f"Python {platform.python_version()}",
        f"PyTorch {th.__version__}",
    ]
    return ", ".join(parts)

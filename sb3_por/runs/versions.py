"""Versions of the code and of the packages that numbers come from. Imports none of the packages."""

import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

#: Packages whose version can change a run's numbers
PACKAGES = ("torch", "numpy", "gymnasium", "pybullet", "pybullet-arm64", "stable-baselines3", "sb3-contrib", "rl_zoo3")


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


def current_versions() -> dict[str, str]:
    """
    :return: ``commit`` (with ``+`` if files differ from it), ``python``, and the version of each of ``PACKAGES`` that is
        installed
    """
    packages = {name: _version(name) for name in PACKAGES}
    installed = {name: number for name, number in packages.items() if number}
    return {"commit": current_commit(), "python": platform.python_version(), **installed}


def differences(before: dict[str, Any], now: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """
    :param before: Versions or provenance that were recorded
    :param now: Those of this process
    :return: name: the two values, of all that differ; None for a value that one of them does not have
    """
    names = sorted({*before, *now})
    return {name: (before.get(name), now.get(name)) for name in names if before.get(name) != now.get(name)}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""

"""Fixtures of all tests."""

import os

import pytest


@pytest.fixture(scope="session", autouse=True)
def sb3_logs(tmp_path_factory):
    """Stable-Baselines3 makes a folder in the machine's temporary one for every training that has no logs, and keeps it."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("sb3_logs"))

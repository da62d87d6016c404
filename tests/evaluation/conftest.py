"""Fixtures of the tests of loading."""

import pytest
from hostile_files import small
from stable_baselines3 import SAC


@pytest.fixture
def marker(tmp_path):
    return tmp_path / "executed"


@pytest.fixture(scope="module")
def sac_zip(tmp_path_factory):
    path = tmp_path_factory.mktemp("sac") / "model.zip"
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, **small()).save(path)
    return path

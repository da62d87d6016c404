"""
Stable-Baselines3's own tests of SAC, with an algorithm of ours in SAC's place.

    python tests/sb3_own_tests.py                            # SACPOR
    python tests/sb3_own_tests.py --algo sac_drq -k her      # further arguments go to pytest

Fetches the source distribution of the installed version with pip. Left out are the tests of what is different on purpose.
"""

import argparse
import inspect
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import pytest
import stable_baselines3
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_por import ALGORITHMS, SACMRQ, SACPOR, SACSPR

#: Tests of what is different on purpose -> why.
DIFFERENT = {
    "test_n_steps_with_dict_obs[None]": "n-step returns work with Dict observations",
    "test_warn_buffer[True-": "optimize_memory_usage changes nothing: the buffer knows that a second learn() resets",
}
#: The same for POR, SPR and MR.Q, which refuse a buffer that cannot sample the frames that their objectives need.
REFUSED = {
    "test_n_steps_warns_with_custom_replay_buffer_class[NStepReplayBuffer]": "NStepReplayBuffer is refused",
    "test_n_steps_custom_class_no_warnings": "NStepReplayBuffer is refused",
}


class InSACsPlace:
    """A pytest plugin that keeps the tests of SAC, and only those."""

    def __init__(self, algorithm: type[BaseAlgorithm]):
        self.algorithm = algorithm
        self.different = DIFFERENT | (REFUSED if algorithm in (SACMRQ, SACPOR, SACSPR) else {})
        stable_baselines3.SAC = algorithm

    def _concerned(self, item: pytest.Function) -> bool:
        if any(item.name.startswith(name) for name in self.different):
            return False
        parameters = item.callspec.params.values() if hasattr(item, "callspec") else ()
        classes = [value for value in parameters if inspect.isclass(value) and issubclass(value, BaseAlgorithm)]
        return self.algorithm in classes if classes else "SAC" in inspect.getsource(item.function)

    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Leave out the tests of other algorithms."""
        left_out = [item for item in items if not (isinstance(item, pytest.Function) and self._concerned(item))]
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=left_out)


def fetch(folder: Path) -> Path:
    """The tests of the installed Stable-Baselines3, in a folder."""
    wanted = f"stable-baselines3=={stable_baselines3.__version__}"
    command = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--no-binary=:all:", "-d", str(folder), wanted]
    subprocess.run(command, check=True)
    (archive,) = folder.glob("*.tar.gz")
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    return next(folder.glob("*/tests"))


def main() -> int:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algo", choices=[name for name in ALGORITHMS if name.startswith("sac")], default="sac_por")
    args, pytest_args = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as folder:
        tests = fetch(Path(folder))
        files = [str(file) for file in sorted(tests.glob("test_*.py")) if "SAC" in file.read_text()]
        # Its own settings for warnings, and a folder that its tests may write in.
        options = ["-c", str(tests.parent / "pyproject.toml"), f"--rootdir={tests.parent}"]
        return pytest.main([*options, *files, *pytest_args], plugins=[InSACsPlace(ALGORITHMS[args.algo])])


if __name__ == "__main__":
    sys.exit(main())

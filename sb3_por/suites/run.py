"""A run of a suite: its folder, its state and its process. Imports no PyTorch, for which a cluster's worker would wait."""

import ctypes
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from sb3_por.runs.folder import LOG, env_name, is_finished, run_arguments


@dataclass(frozen=True)
class Run:
    """
    One run of a suite.

    :param folder: ``<root>/<env>/<algo or variant>/seed_<seed>``; the zoo's layout begins in it
    :param flags: Flags of train.py besides algorithm, environment, seed, folder and label
    :param variant: name of the suite's variant; empty for the algorithm itself
    """

    algo: str
    env: str
    seed: int
    folder: Path
    flags: tuple[str, ...]
    variant: str = ""

    @property
    def name(self) -> str:
        return f"{self.env}/{self.variant or self.algo}/seed_{self.seed}"

    @property
    def run_folder(self) -> Path:
        """Folder to which train.py writes."""
        return self.folder / self.algo / f"{env_name(self.env)}_1"

    @property
    def log(self) -> Path:
        return self.folder / LOG

    def state(self) -> str:
        """``"finished"``, ``"interrupted"``, or ``"new"``."""
        if is_finished(self.run_folder, self.env):
            return "finished"
        return "interrupted" if run_arguments(self.run_folder) else "new"

    def command(self) -> list[str]:
        """The command that starts or resumes the run."""
        train = [sys.executable, "-m", "sb3_por.zoo"]
        if self.state() == "interrupted":
            return [*train, "--resume", str(self.run_folder)]
        named = ["--algo", self.algo, "--env", self.env, "--seed", str(self.seed), "-f", str(self.folder)]
        label = ["--label", self.variant] if self.variant else []
        return [*train, *named, *label, *self.flags]


def start_process(run: Run, threads: int) -> subprocess.Popen:
    """
    Start or resume a run. It dies with the process that calls this, and writes to ``run.log``.

    :param threads: threads of its numerical libraries
    """
    command = run.command()
    if run.state() == "new":
        # What a process left that was killed before it had written its settings.
        shutil.rmtree(run.run_folder, ignore_errors=True)
    run.folder.mkdir(parents=True, exist_ok=True)
    of_libraries = {name: str(threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
    # Otherwise an error stands in the log before what was printed earlier and kept in a buffer.
    in_order = {"PYTHONUNBUFFERED": "1"}
    with open(run.log, "ab") as log:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=os.environ | of_libraries | in_order,
            start_new_session=True,
            preexec_fn=die_with_parent,
        )


def die_with_parent() -> None:
    """A killed suite must not leave processes behind that its next start would run a second time (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)

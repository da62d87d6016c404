"""What a run can do without while its disk is full: it writes a note, continues, and writes again when there is room."""

import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.monitor import Monitor, ResultsWriter
from torch.utils.tensorboard import SummaryWriter

from sb3_por.common.errors import UserNote
from sb3_por.common.files import PROBE_SIZE, DiskError, disk_errors


@contextmanager
def forgoing(consequence: str) -> Iterator[None]:
    """
    A context that writes what a run can do without. On a disk that cannot be written, a note, and the run continues.

    :param consequence: What is missing then, for the note
    """
    try:
        yield
    except DiskError as error:
        warnings.warn(f"{error}. The run continues; {consequence}", UserNote)


class _PatientResults(ResultsWriter):
    """SB3's table of episodes. Rows that a full disk does not take stay in the file's buffer and are written with the next."""

    def write_row(self, epinfo: dict[str, float]) -> None:
        with suppress(OSError):
            super().write_row(epinfo)

    def close(self) -> None:
        with suppress(OSError):
            super().close()


def keep_playing(env: gym.Env) -> gym.Env:
    """
    Let an environment play on while the disk of its ``monitor.csv`` is full.

    :param env: An environment, perhaps inside SB3's ``Monitor``
    :return: The same
    """
    inner = env
    while isinstance(inner, gym.Wrapper):
        if isinstance(inner, Monitor) and inner.results_writer is not None:
            # SB3 makes Monitor and writer in one call, in the worker process: the class is what can be changed after it.
            inner.results_writer.__class__ = _PatientResults
        inner = inner.env
    return env


class PatientTensorBoard(TensorBoardOutputFormat):
    """
    SB3's writer of TensorBoard files. While the disk is full, rows are left out; then it begins another file.

    :param writer: Writer to replace
    """

    def __init__(self, writer: TensorBoardOutputFormat) -> None:
        self.writer = writer.writer
        self._folder = Path(self.writer.log_dir)
        self._is_closed = False
        self._lacks_room = False

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        try:
            with disk_errors(self._folder / "events"):
                # TensorBoard writes in a thread, whose error would be printed with its traceback: look first.
                if shutil.disk_usage(self._folder).free < PROBE_SIZE:
                    raise OSError("full")
                if self._lacks_room:
                    self.writer = SummaryWriter(str(self._folder))
                super().write(key_values, key_excluded, step)
            self._lacks_room = False
        except DiskError as error:
            if not self._lacks_room:
                warnings.warn(f"{error}. The run continues; what is logged until then will be missing", UserNote)
                with suppress(OSError):
                    self.writer.close()
            self._lacks_room = True

    def close(self) -> None:
        with suppress(OSError):
            super().close()


class PatientLogs(BaseCallback):
    """Lets TensorBoard's files wait for room on a full disk."""

    def _on_training_start(self) -> None:
        formats = self.model.logger.output_formats
        formats[:] = [PatientTensorBoard(one) if type(one) is TensorBoardOutputFormat else one for one in formats]

    def _on_step(self) -> bool:
        return True

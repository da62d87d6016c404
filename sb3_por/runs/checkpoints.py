"""Checkpoints that a killed run is resumed from: model, replay buffer and random states, written atomically."""

import hashlib
import json
import os
import pickle
import shutil
import uuid
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_por.common.files import DiskError, atomic_write, disk_errors
from sb3_por.common.random_state import get_rng_state
from sb3_por.runs.folder import CHECKPOINTS, MONITORS, STATISTICS, discard, latest_checkpoint, settings_folder

#: Model in the folder of a checkpoint
MODEL = "model.zip"
#: Folder of the blocks of replay buffers, beside the checkpoints
BLOCKS = "blocks"
#: Bytes of a replay buffer that are stored together; only blocks that changed are written again.
BLOCK_SIZE = 4 * 2**20


def save_checkpoint(model: BaseAlgorithm, run: Path, env_id: str, seconds: float = 0.0) -> Path:
    """
    Write ``<run>/checkpoint/step_<n>`` and remove older ones. The folder appears when all of it is on disk.

    The replay buffer is stored as compressed blocks named by their content, ``<run>/checkpoint/blocks``, so that a
    checkpoint costs the transitions that are new since the last one, and the time to hash the others.

    :param model: the model, between two rollouts
    :param run: the run's folder
    :param env_id: names the folder of ``VecNormalize`` statistics, as in the zoo
    :param seconds: Wall-clock time of the run so far
    :return: The new folder
    :raises DiskError: If the disk is full, read-only or out of reach; the checkpoint before stays
    """
    root = run / CHECKPOINTS
    final = root / f"step_{model.num_timesteps}"
    if final.exists():
        return final
    before = latest_checkpoint(run)
    try:
        with disk_errors(final):
            _write_checkpoint(model, run, env_id, seconds)
    except DiskError:
        # Make room again: the run may continue.
        with suppress(OSError):
            _remove_all_but(before, root)
        raise
    _remove_all_but(final, root)
    return final


def _write_checkpoint(model: BaseAlgorithm, run: Path, env_id: str, seconds: float) -> None:
    """See :func:`save_checkpoint`."""
    root = run / CHECKPOINTS
    temporary = root / f".{uuid.uuid4().hex}"
    temporary.mkdir(parents=True)
    model.save(temporary / MODEL)
    (temporary / "rng.pickle").write_bytes(pickle.dumps(get_rng_state(model.action_space)))
    monitors = {file.name: file.stat().st_size for file in run.glob(MONITORS)}
    (temporary / "monitors.json").write_text(json.dumps(monitors))
    (temporary / "seconds.json").write_text(json.dumps(seconds))
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None:
        _write_buffer(buffer, temporary, root / BLOCKS)
    statistics = model.get_vec_normalize_env()
    if statistics is not None:
        folder = settings_folder(temporary, env_id)
        folder.mkdir()
        statistics.save(str(folder / STATISTICS))
    for file in temporary.rglob("*"):
        if file.is_file():
            with open(file, "rb") as opened:
                os.fsync(opened.fileno())
    temporary.rename(root / f"step_{model.num_timesteps}")


def _remove_all_but(checkpoint: Path | None, root: Path) -> None:
    """Remove other checkpoints, unfinished ones and the blocks of neither."""
    for stale in root.iterdir() if root.is_dir() else ():
        if stale.name != BLOCKS and stale != checkpoint:
            discard(stale)
    used = set() if checkpoint is None else {name for names in _block_names(checkpoint) for name in names}
    for block in (root / BLOCKS).glob("*"):
        if block.name not in used:
            block.unlink()


def _block_names(checkpoint: Path) -> list[list[str]]:
    """Names of the blocks of each array of a checkpoint's replay buffer."""
    file = checkpoint / "blocks.json"
    return json.loads(file.read_text()) if file.is_file() else []


def remove_checkpoints(run: Path) -> None:
    """Remove all checkpoints of a finished run."""
    for folder in (run / CHECKPOINTS).glob("step_*"):
        discard(folder)
    shutil.rmtree(run / CHECKPOINTS, ignore_errors=True)


def restore_monitors(run: Path, checkpoint: Path) -> None:
    """Remove the episodes that ended after a checkpoint from the run's ``*.monitor.csv``; they are played again."""
    for name, size in json.loads((checkpoint / "monitors.json").read_text()).items():
        file = run / name
        if file.stat().st_size > size:
            os.truncate(file, size)


def restore_buffer(model: BaseAlgorithm, checkpoint: Path) -> None:
    """Give a loaded model the replay buffer of a checkpoint."""
    if not (checkpoint / "buffer.pickle").is_file():
        return
    blocks = checkpoint.parent / BLOCKS
    arrays = []
    for names in _block_names(checkpoint):
        arrays.append(bytearray().join(zlib.decompress((blocks / name).read_bytes()) for name in names))
    buffer = pickle.loads((checkpoint / "buffer.pickle").read_bytes(), buffers=arrays)
    buffer.device = model.device
    if isinstance(buffer, HerReplayBuffer) and model.env is not None:
        buffer.set_env(model.env)
    if type(buffer) is NStepReplayBuffer and buffer.size() > 0:
        # The environment starts anew: returns of several steps must not run on into that episode. Our buffer knows.
        last = buffer.pos - 1
        buffer.timeouts[last] = np.maximum(buffer.timeouts[last], 1 - buffer.dones[last])
    vars(model)["replay_buffer"] = buffer


def read_rng_state(checkpoint: Path) -> dict[str, Any]:
    """The states of the random generators at a checkpoint, for :func:`sb3_por.common.random_state.set_rng_state`."""
    return pickle.loads((checkpoint / "rng.pickle").read_bytes())


def read_seconds(checkpoint: Path) -> float:
    """Wall-clock time of the run at a checkpoint; 0 if it was not recorded."""
    file = checkpoint / "seconds.json"
    return float(json.loads(file.read_text())) if file.is_file() else 0.0


def _write_buffer(buffer: Any, folder: Path, blocks: Path) -> None:
    arrays: list[pickle.PickleBuffer] = []
    stream = pickle.dumps(buffer, protocol=5, buffer_callback=arrays.append)
    blocks.mkdir(exist_ok=True)
    names = [[_write_block(part, blocks) for part in _parts(array.raw())] for array in arrays]
    (folder / "buffer.pickle").write_bytes(stream)
    (folder / "blocks.json").write_text(json.dumps(names))


def _parts(data: memoryview) -> list[memoryview]:
    return [data[start : start + BLOCK_SIZE] for start in range(0, len(data), BLOCK_SIZE)]


def _write_block(data: memoryview, blocks: Path) -> str:
    """
    :return: its name: the hash of its content
    """
    name = hashlib.blake2b(data, digest_size=16).hexdigest()
    if not (blocks / name).exists():
        with atomic_write(blocks / name) as path:
            # The fastest level makes images of simple scenes ten times smaller.
            path.write_bytes(zlib.compress(data, level=1))
    return name

"""Minari datasets in a folder: written and read episode by episode, and checked where they enter."""

import json
import shutil
import uuid
import warnings
from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from sb3_por.common.errors import UserError, UserNote, one_line
from sb3_por.common.files import check_writable

#: File that Minari keeps in every dataset
METADATA = "metadata.json"
#: Arguments of an environment that change neither what an action does nor what it earns
IRRELEVANT = {"obs_type", "image_size", "split", "renderer", "render_mode", "render_size"}


@dataclass(frozen=True)
class RecordedEpisode:
    """
    One episode of n steps.

    :param observations: o_0, ..., o_n as the environment returned them, shape ``(n + 1, ...)``; a dict of arrays for ``Dict``
        observations
    :param actions: a_0, ..., a_{n-1}, shape ``(n, action_dim)``
    :param rewards: Shape ``(n,)``
    :param terminated: Whether the last step ended the episode; otherwise it was cut off there
    :param seed: Seed of the reset; None if it had none
    """

    observations: Any
    actions: np.ndarray
    rewards: np.ndarray
    terminated: bool
    seed: int | None = None


class Demonstrations:
    """
    A Minari dataset on disk. Episodes are read one at a time.

    :param path: Folder of the dataset: the one with ``metadata.json``, or the one around its ``data``
    :raises UserError: If there is no dataset that can be read, or no episode in it
    """

    def __init__(self, path: str | Path) -> None:
        minari = _minari()
        self.path = next((folder for folder in (Path(path), Path(path) / "data") if (folder / METADATA).is_file()), Path(path))
        if not (self.path / METADATA).is_file():
            inner = sorted(file.parent for deep in ("*", "*/data") for file in Path(path).glob(f"{deep}/{METADATA}"))
            hint = f"did you mean {inner[0]}?" if inner else "see python -m sb3_por record"
            raise UserError(f"there are no demonstrations in {path}: no {METADATA} of a Minari dataset; {hint}")
        try:
            self._dataset = minari.MinariDataset(self.path)
        # Whatever a damaged or foreign file makes Minari and h5py raise
        except Exception as error:
            raise UserError(f"cannot read the Minari dataset {self.path}: {one_line(error)}") from error
        if len(self._dataset) == 0:
            raise UserError(f"the Minari dataset {self.path} has no episodes")
        self.observation_space: spaces.Space = self._dataset.observation_space
        self.action_space: spaces.Space = self._dataset.action_space
        #: Gymnasium's specification of the environment; None if nobody has recorded it
        self.spec: EnvSpec | None = self._dataset.env_spec

    def __len__(self) -> int:
        """:return: Number of episodes"""
        return len(self._dataset)

    def episodes(self) -> Iterator[RecordedEpisode]:
        """
        :return: The episodes in their order
        :raises UserError: If one is damaged, has no actions, or holds NaN
        """
        for number in range(len(self)):
            try:
                read = self._dataset[number]
                episode = RecordedEpisode(
                    observations=read.observations,
                    actions=np.asarray(read.actions),
                    rewards=np.asarray(read.rewards, dtype=np.float64),
                    terminated=bool(np.asarray(read.terminations)[-1]),
                )
            except Exception as error:  # as above
                raise UserError(f"cannot read episode {number} of {self.path}: {one_line(error)}") from error
            if problem := self._problem(episode):
                raise UserError(f"episode {number} of {self.path} cannot be used: {problem}")
            yield episode

    def _problem(self, episode: RecordedEpisode) -> str | None:
        """What is wrong with an episode."""
        n = len(episode.rewards)
        parts = list(episode.observations.values()) if isinstance(episode.observations, dict) else [episode.observations]
        if not all(isinstance(part, np.ndarray) and part.dtype.kind in "biuf" for part in parts):
            return "its observations are neither an array of numbers nor named arrays, as algorithms here need"
        if n == 0 or episode.actions.shape != (n, *(self.action_space.shape or ())):
            return f"{n} rewards, and actions of shape {episode.actions.shape} for {self.action_space}"
        if any(len(part) != n + 1 for part in parts):
            return f"{n} steps need {n + 1} observations, the last one included"
        if not all(np.isfinite(part).all() for part in (*parts, episode.actions, episode.rewards)):
            return "it holds numbers that are not finite"
        return None


def write_demonstrations(
    path: str | Path,
    episodes: Iterable[RecordedEpisode],
    observation_space: spaces.Space,
    action_space: spaces.Space,
    spec: EnvSpec | None = None,
    **description: Any,
) -> None:
    """
    Write a Minari dataset. The folder appears when all of it is on disk. Images are stored without loss.

    :param path: The new folder; Minari's name of the dataset is made of its name
    :param episodes: Episodes to write, taken one by one
    :param observation_space: Space of the observations
    :param action_space: Space of the actions
    :param spec: Gymnasium's specification of the environment, so that Minari can make it
    :param description: Further metadata, such as ``algorithm_name``
    :raises UserError: If the folder exists or cannot be written
    """
    minari = _minari()
    from minari.data_collector.episode_buffer import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    path = Path(path).absolute()  # Minari joins a relative one twice
    check_new(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        storage = MinariStorage.new(temporary, observation_space, action_space, _as_text(spec), jpeg_encoding=False)
        for episode in episodes:
            steps = np.arange(len(episode.rewards))
            ends = steps == len(steps) - 1
            buffer = EpisodeBuffer(
                seed=episode.seed,
                observations=episode.observations,
                actions=episode.actions,  # type: ignore[arg-type]  # a list of them in Minari's annotation, an array on disk
                rewards=list(episode.rewards),
                terminations=list(ends & episode.terminated),
                truncations=list(ends & (not episode.terminated)),
            )
            storage.update_episodes([buffer])
        name = f"{''.join(c if c.isalnum() else '-' for c in path.resolve().name)}-v0"
        storage.update_metadata({"dataset_id": name, "minari_version": minari.__version__, **description})
        temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def describe(spec: EnvSpec) -> str:
    """
    :param spec: Gymnasium's specification of an environment
    :return: Its id, its arguments and its wrappers as far as their arguments are known, without what spaces tell and what
        decides the scenes, the length of an episode and how it is shown
    """
    kwargs = {name: value for name, value in sorted(spec.kwargs.items()) if name not in IRRELEVANT}
    wrappers = [f"{one.name} {one.kwargs}" for one in spec.additional_wrappers if one.kwargs]
    return " in ".join([f"{spec.id} {kwargs}", *wrappers])


def _as_text(spec: EnvSpec | None) -> EnvSpec | None:
    """The specification as JSON can hold it: a class by its path, and none with arguments that have no text."""
    if spec is None:
        return None
    spec, made_by = copy(spec), cast(Any, spec.entry_point)
    if hasattr(made_by, "__qualname__"):
        spec.entry_point = f"{made_by.__module__}:{made_by.__qualname__}"
    try:
        spec.to_json()
    except (TypeError, ValueError) as error:
        warnings.warn(f"the demonstrations do not tell how to make {spec.id}: {one_line(error)}", UserNote)
        return None
    return spec


def check_new(path: str | Path) -> None:
    """
    :param path: Folder of a dataset that is to be written
    :raises UserError: If it exists, or cannot be made
    """
    path = Path(path)
    if path.exists():
        raise UserError(f"{path} exists; give a new folder")
    check_writable(path.parent)


def read_description(path: str | Path) -> dict[str, Any]:
    """
    :param path: Folder of a dataset
    :return: Its metadata as they stand in its file
    """
    return json.loads((Demonstrations(path).path / METADATA).read_text())


def _minari() -> Any:
    """
    :return: The package, which is optional
    :raises UserError: If it is not installed
    """
    try:
        import minari
    except ImportError as error:
        raise UserError("demonstrations need Minari: pip install 'sb3-por[demos]' (Python 3.11 or newer)") from error
    return minari

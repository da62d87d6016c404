"""States of the global random generators, with which a loaded model continues as if it had never stopped."""

import io
import pathlib
import random
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback


def get_rng_state(action_space: spaces.Space) -> dict[str, Any]:
    """
    :param action_space: Space whose generator draws the random actions of the warm-up
    :return: States of the generators of Python, numpy, torch and the action space
    """
    return dict(
        python=random.getstate(),
        numpy=np.random.get_state(),
        torch=th.get_rng_state().numpy(),
        cuda=[state.numpy() for state in th.cuda.get_rng_state_all()] if th.cuda.is_available() else [],
        action_space=action_space.np_random.bit_generator.state,
    )


def set_rng_state(state: dict[str, Any], action_space: spaces.Space) -> None:
    """
    :param state: From ``get_rng_state``
    :param action_space: Space whose generator draws the random actions of the warm-up
    """
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(th.from_numpy(state["torch"]))
    if th.cuda.is_available() and len(state["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all([th.from_numpy(one) for one in state["cuda"]])
    action_space.np_random.bit_generator.state = state["action_space"]


class SavedRandomState(OffPolicyAlgorithm):
    """
    A mixin that saves the states of the random generators with the model. ``learn(reset_num_timesteps=False)`` of a loaded
    model restores them.
    """

    #: States of a loaded model that are not restored yet
    rng_state: dict[str, Any] | None = None

    def _setup_model(self) -> None:
        rng_state = self.rng_state  # of a loaded model: the seed that SB3 sets here is that of its first start
        super()._setup_model()
        self.rng_state = rng_state

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> Any:
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        if self.rng_state is not None and not reset_num_timesteps:
            set_rng_state(self.rng_state, self.action_space)
        self.rng_state = None
        return result

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        :param seed: Seed of the random generators; discards the states of a loaded model
        """
        super().set_random_seed(seed)
        self.rng_state = None

    @classmethod
    def load(cls, *args: Any, **kwargs: Any) -> Any:
        """See SB3. A ``seed`` among the arguments discards the saved states of the random generators."""
        model = super().load(*args, **kwargs)
        if "seed" in kwargs:
            model.rng_state = None
        return model

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save all attributes, networks, optimizers and the states of the random generators in a zip file.

        :param path: Path to the file
        :param exclude: Names of attributes to leave out
        :param include: Names of attributes to save although they are left out by default
        """
        loaded = self.rng_state  # of a model that was loaded and has not learned since
        self.rng_state = loaded or get_rng_state(self.action_space)
        try:
            super().save(path, exclude, include)
        finally:
            self.rng_state = loaded

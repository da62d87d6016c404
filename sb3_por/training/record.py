"""Record demonstrations: a policy plays training scenes in the environment that an algorithm's settings make."""

from copy import deepcopy
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_por.common.errors import UserError, one_line
from sb3_por.demonstrations.dataset import RecordedEpisode, check_new, write_demonstrations
from sb3_por.evaluation.environment import make_evaluation_env
from sb3_por.evaluation.episodes import (
    Episode,
    Evaluation,
    FixedEpisodes,
    Model,
    run_episodes,
    scene_kwargs,
    training_episodes,
)
from sb3_por.evaluation.loading import resolve
from sb3_por.runs.environment import EnvWrapper, TrainingEnvironment, import_wrappers
from sb3_por.runs.folder import import_names
from sb3_por.training.checks import check_names
from sb3_por.training.hyperparameters import changed, hyperparameter_file, read_hyperparameters
from softbody_envs.experts import make_expert
from softbody_envs.experts.pace import Pace

#: Name of the scripted expert among models.
EXPERT = "expert"
#: Fewest and most steps of a disturbance
DISTURBANCE_STEPS = (3, 8)


class Recorder(gym.Wrapper[Any, np.ndarray, Any, np.ndarray]):
    """
    Keep every episode that ends in ``episodes``; one that a reset cuts off is lost.

    An expert that never errs does not show how an error is made good. A disturbance is one random action, held for a few
    steps (``DISTURBANCE_STEPS``). It is not recorded: what comes before it and what comes after it are episodes of their own,
    so that nobody learns to err (after DART, https://arxiv.org/abs/1703.09327, which adds noise to actions).

    :param env: The environment
    :param disturbed: Probability that a disturbance follows a step
    """

    def __init__(self, env: gym.Env[Any, np.ndarray], disturbed: float = 0.0) -> None:
        super().__init__(env)
        self.episodes: list[RecordedEpisode] = []
        self.disturbed = disturbed

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See ``gymnasium.Env.reset``."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._seed, self._rng = seed, np.random.default_rng(seed)
        self._begin(observation)
        return observation, info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See ``gymnasium.Env.step``; with a disturbance, the sum of the rewards until it ends, and what it ends with."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._observations.append(deepcopy(observation))  # some environments reuse their arrays
        self._actions.append(np.array(action))
        self._rewards.append(float(reward))
        if terminated or truncated:
            self._keep(terminated)
        elif self._rng.random() < self.disturbed:
            self._keep(terminated=False)
            push, total = self._random_action(), float(reward)
            for _ in range(self._rng.integers(*DISTURBANCE_STEPS, endpoint=True)):
                observation, reward, terminated, truncated, info = self.env.step(push)
                total += float(reward)
                if terminated or truncated:
                    break
            self._begin(observation)
            reward = total
        return observation, float(reward), terminated, truncated, info

    def _begin(self, observation: Any) -> None:
        self._observations, self._actions, self._rewards = [deepcopy(observation)], list[np.ndarray](), list[float]()

    def _keep(self, terminated: bool) -> None:
        observations = _stack(self._observations)
        actions, rewards = np.stack(self._actions), np.array(self._rewards)
        self.episodes.append(RecordedEpisode(observations, actions, rewards, terminated, self._seed))

    def _random_action(self) -> np.ndarray:
        space = self.action_space
        assert isinstance(space, gym.spaces.Box)  # as everywhere in SAC
        return self._rng.uniform(space.low, space.high).astype(space.dtype)


class AttachedExpert:
    """
    Scripted expert that reads the state of an environment, whatever is observed there. It may try a scene ``attempts`` times:
    ``again`` says that the next episode is another attempt.

    :param env_id: Gymnasium id of a task with an expert
    :param env: The environment, inside its wrappers
    :raises UserError: If the task has no expert
    """

    def __init__(self, env_id: str, env: gym.Env[Any, np.ndarray]) -> None:
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self._env: Any = env.unwrapped
        try:
            self._expert: Any = make_expert(env_id, Pace.of(env))
        except ValueError as error:
            raise UserError(one_line(error)) from error
        self.attempts: int = getattr(self._expert, "attempts", 1)
        self.again = False

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Any]:
        """Return the expert's action, shape ``(1, action_dim)``."""
        if episode_start is None or episode_start[0]:
            self._expert.retry() if self.again else self._expert.reset()
        return self._expert.act(self._env.state())[None].astype(np.float32), state


def settings_environment(
    algo: str,
    env_id: str,
    conf_file: str | None = None,
    changes: dict[str, Any] | None = None,
    env_kwargs: dict[str, Any] | None = None,
    demos: bool = True,
) -> TrainingEnvironment:
    """
    :param algo: Name of an algorithm
    :param env_id: Gymnasium id
    :param conf_file: Settings in the RL Zoo's format; the file that ``train.py`` would choose by default
    :param changes: Changes to the settings
    :param env_kwargs: Changes to the arguments of the environment
    :param demos: Whether it is for learning from demonstrations
    :return: The environment that ``train.py``, with ``--demos`` or without, would train in
    :raises UserError: If there are no settings
    """
    settings = read_hyperparameters(conf_file or hyperparameter_file(algo, env_id, demos), env_id)
    changes = changes or {}
    check_names(algo, changes)
    settings = changed(settings, changes, {"env_kwargs": env_kwargs})
    return TrainingEnvironment.of_settings(env_id, settings)


@dataclass(frozen=True)
class Recording:
    """
    Episodes of training scenes.

    :param evaluation: Their scores
    :param episodes: The episodes, as the environment inside its wrappers gave them: before frames are stacked and observations
        normalized
    :param env: The environment, closed
    """

    evaluation: Evaluation
    episodes: list[RecordedEpisode]
    env: gym.Env[Any, np.ndarray]


def record(
    model: Model | str | Path,
    env_id: str,
    path: str | Path,
    n_episodes: int,
    seed: int = 0,
    made_of: TrainingEnvironment | None = None,
    safe: bool = False,
    disturbed: float = 0.0,
) -> Evaluation:
    """
    Write episodes of training scenes as a Minari dataset.

    :param model: See :func:`find_player`
    :param env_id: Gymnasium id
    :param path: Folder of the new dataset
    :param n_episodes: See :func:`play_training_scenes`
    :param seed: See :func:`play_training_scenes`
    :param made_of: See :func:`find_player`
    :param safe: Run nothing that the model's file or folder holds
    :param disturbed: See :class:`Recorder`
    :return: The scores of the episodes
    :raises UserError: If the model or the environment cannot be made, or the folder cannot be written
    """
    check_new(path)
    player, environment = find_player(model, env_id, made_of, safe)
    recording = play_training_scenes(player, env_id, environment, n_episodes, seed, disturbed)
    write_demonstrations(
        path,
        recording.episodes,
        recording.env.observation_space,
        recording.env.action_space,
        recording.env.spec,
        algorithm_name=model if isinstance(model, str) else type(player).__name__,
        description=f"{env_id}: {recording.evaluation}",
    )
    return recording.evaluation


def find_player(
    model: Model | str | Path, env_id: str, made_of: TrainingEnvironment | None = None, safe: bool = False
) -> tuple[Any, dict[str, Any]]:
    """
    :param model: ``"expert"`` for the task's scripted expert, a run folder, the path of a model, or a model
    :param env_id: Gymnasium id
    :param made_of: Parts of the environment; by default those that the model was trained in, and for the expert those of
        ``sac_por``
    :param safe: Run nothing that the model's file or folder holds
    :return: The model, None for the expert; and arguments of ``make_evaluation_env``
    :raises UserError: If the model cannot be loaded
    """
    loaded, environment = (None, {}) if model == EXPERT else resolve(model, env_id, safe=safe)
    if made_of is None and loaded is None:
        made_of = settings_environment("sac_por", env_id)
    return loaded, environment | (environment_parts(made_of) if made_of is not None else {})


def play_training_scenes(
    player: Any, env_id: str, environment: dict[str, Any], n_episodes: int, seed: int = 0, disturbed: float = 0.0
) -> Recording:
    """
    Play episodes of training scenes, never of held-out ones.

    :param player: A model, or None for the task's scripted expert
    :param env_id: Gymnasium id
    :param environment: Arguments of ``make_evaluation_env``
    :param n_episodes: Number of episodes, of different scenes as long as there are any left
    :param seed: Chooses the scenes; episode k is reset with ``seed + k``
    :param disturbed: See :class:`Recorder`
    :return: The episodes and their scores
    :raises UserError: If the environment cannot be made
    """
    if n_episodes < 1:
        raise UserError(f"a recording needs at least 1 episode, got {n_episodes}")
    if not 0.0 <= disturbed < 1.0:
        raise UserError(f"the probability of a disturbance must be at least 0 and less than 1, got {disturbed}")
    env = make_training_env(env_id, environment["env_kwargs"], environment["env_wrapper"])
    recorder = Recorder(Monitor(env), disturbed)
    if player is None:
        player = AttachedExpert(env_id, env)
        venv: VecEnv = DummyVecEnv([lambda: FixedEpisodes(recorder)])
    else:
        venv = make_evaluation_env(player, env_id, **environment | {"env_wrapper": lambda _: recorder})
    try:
        evaluations, recorded = list[Evaluation](), list[RecordedEpisode]()
        for episode in training_episodes(env_id, n_episodes, seed):
            evaluation, demonstrations = _best_attempt(player, venv, recorder, episode)
            evaluations.append(evaluation)
            recorded += demonstrations
    finally:
        venv.close()
    return Recording(_joined(evaluations), recorded, env)


def make_training_env(env_id: str, env_kwargs: dict[str, Any], env_wrapper: EnvWrapper | None) -> gym.Env[Any, np.ndarray]:
    """
    :param env_id: Gymnasium id
    :param env_kwargs: Arguments of the environment's constructor
    :param env_wrapper: Wrappers
    :return: The environment, with training scenes
    :raises UserError: If it cannot be made
    """
    kwargs = env_kwargs | scene_kwargs(env_id, "train")
    try:
        env: gym.Env[Any, np.ndarray] = gym.make(env_id, **kwargs)
        return env if env_wrapper is None else env_wrapper(env)
    except (TypeError, ValueError, gym.error.Error) as error:
        raise UserError(f"cannot make {env_id}: {one_line(error)}") from error


def environment_parts(made_of: TrainingEnvironment) -> dict[str, Any]:
    """
    :param made_of: Parts of an environment by their names
    :return: ``env_kwargs`` and ``env_wrapper`` for ``make_training_env``
    :raises UserError: If a wrapper cannot be imported
    """
    return {"env_kwargs": import_names(made_of.env_kwargs or {}), "env_wrapper": import_wrappers(made_of.env_wrapper)}


def _best_attempt(player: Any, venv: VecEnv, recorder: Recorder, episode: Episode) -> tuple[Evaluation, list[RecordedEpisode]]:
    """Play an episode; an expert with several plans plays it until it succeeds, and its best attempt counts."""
    attempts = []
    for attempt in range(getattr(player, "attempts", 1)):
        if isinstance(player, AttachedExpert):
            player.again = attempt > 0
        recorder.episodes.clear()
        evaluation = run_episodes(player, venv, [episode])
        attempts.append((evaluation, recorder.episodes[:]))
        if evaluation.successes[0] == 1.0:
            break
    return max(attempts, key=lambda one: one[0].score)


def _joined(evaluations: list[Evaluation]) -> Evaluation:
    """One evaluation of all their episodes."""
    names = [field.name for field in fields(Evaluation)]
    return Evaluation(**{name: [value for one in evaluations for value in getattr(one, name)] for name in names})


def _stack(observations: list[Any]) -> Any:
    """One array with an axis for time, or a dict of them."""
    if isinstance(observations[0], dict):
        return {key: np.stack([one[key] for one in observations]) for key in observations[0]}
    return np.stack(observations)

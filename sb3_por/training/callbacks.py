"""Callbacks of a run: evaluation on held-out episodes, and checkpoints."""

import time
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_por.common.errors import UserError
from sb3_por.common.files import atomic_write
from sb3_por.common.random_state import set_rng_state
from sb3_por.evaluation.episodes import Episode, Evaluation, has_diverged, run_episodes, score
from sb3_por.runs.checkpoints import save_checkpoint
from sb3_por.runs.folder import BEST_MODEL, EVALUATIONS, intermediate_model
from sb3_por.training.full_disk import forgoing


def is_due(callback: BaseCallback, interval: int) -> bool:
    """
    Whether ``num_timesteps`` has just reached or passed a multiple of ``interval``. Unlike SB3's count of calls, it is
    in environment steps for any number of environments, and a resumed run keeps the rhythm.
    """
    n_envs = callback.training_env.num_envs
    return callback.num_timesteps // interval > (callback.num_timesteps - n_envs) // interval


class Stopwatch:
    """
    Wall-clock time of a run, with the time before its last checkpoint if it was resumed.

    :param before: Seconds before the checkpoint
    """

    def __init__(self, before: float = 0.0) -> None:
        self._before = before
        self._started = time.monotonic()

    def seconds(self) -> float:
        """Seconds so far."""
        return self._before + time.monotonic() - self._started


class EvaluationCallback(EvalCallback):
    """
    Plays the same held-out episodes at regular intervals and at the end of training.

    Writes ``evaluations.npz`` in SB3's format (``timesteps``, ``results``, ``ep_lengths``, ``successes``) with
    ``normalized_performance``, of the same shape as ``results``, and ``wall_clock_s``, the seconds so far; keeps the
    model with the best mean normalized performance as ``best_model.zip``; logs ``eval/*``.

    :param eval_env: Environments, as :func:`sb3_por.evaluation.episodes.run_episodes` takes them
    :param episodes: Episodes to play
    :param eval_freq: Interval in environment steps
    :param run: Folder of the run
    :param stopwatch: Stopwatch of the run
    :param callback_on_new_best: Called when there is a new best model
    :param verbose: 1 to print a line for each evaluation
    """

    def __init__(
        self,
        eval_env: VecEnv,
        episodes: list[Episode],
        eval_freq: int,
        run: str | Path,
        stopwatch: Stopwatch,
        callback_on_new_best: BaseCallback | None = None,
        verbose: int = 1,
    ) -> None:
        super().__init__(
            eval_env,
            callback_on_new_best=callback_on_new_best,
            n_eval_episodes=len(episodes),
            eval_freq=eval_freq,
            log_path=str(run),
            best_model_save_path=str(run),
            verbose=verbose,
        )
        self.episodes = episodes
        self.run = Path(run)
        self._history: dict[str, list[Any]] = {}
        self.stopwatch = stopwatch

    def _init_callback(self) -> None:
        self.run.mkdir(parents=True, exist_ok=True)
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.init_callback(self.model)

    def _on_training_start(self) -> None:
        file = self.run / EVALUATIONS
        if self.num_timesteps > 0 and file.is_file():
            self._keep_earlier(file)

    def _keep_earlier(self, file: Path) -> None:
        """Keep the evaluations up to the step at which a run is resumed."""
        with np.load(file) as arrays:
            kept = arrays["timesteps"] <= self.num_timesteps
            self._history = {name: list(arrays[name][kept]) for name in arrays.files}
        if kept.any():
            episodes = len(self._history["results"][0])
            if episodes != len(self.episodes):
                raise UserError(f"{file} has evaluations of {episodes} episodes: resume with --eval-episodes {episodes}")
            rows = zip(self._history["normalized_performance"], self._history["results"], strict=True)
            self.best_mean_reward = max(score(performance, returns) for performance, returns in rows)

    def _on_step(self) -> bool:
        return self._evaluate() if is_due(self, self.eval_freq) else True

    def _on_training_end(self) -> None:
        if self._history.get("timesteps", [-1])[-1] != self.num_timesteps:
            self._evaluate()

    def _evaluate(self) -> bool:
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)
        evaluation = run_episodes(self.model, self.eval_env, self.episodes)
        self._record(evaluation)
        if self.verbose > 0:
            print(f"Step {self.num_timesteps}: {evaluation}")

        self.last_mean_reward = float(np.mean(evaluation.returns))
        go_on = True
        if evaluation.score > self.best_mean_reward:
            with forgoing(f"{BEST_MODEL} is not the best model, and the next evaluation that beats it replaces it"):
                with atomic_write(self.run / BEST_MODEL) as path:
                    self.model.save(path)
                if self.callback_on_new_best is not None:
                    go_on = self.callback_on_new_best.on_step()
                # SB3 calls the number that models are ranked by a reward, and other callbacks read it under that name.
                self.best_mean_reward = evaluation.score
        return go_on

    def _record(self, evaluation: Evaluation) -> None:
        """Append to ``evaluations.npz`` and to the logger."""
        row = {
            "timesteps": self.num_timesteps,
            "results": evaluation.returns,
            "ep_lengths": evaluation.lengths,
            "successes": evaluation.successes,
            "normalized_performance": evaluation.normalized_performance,
            "wall_clock_s": self.stopwatch.seconds(),
        }
        for name, value in row.items():
            self._history.setdefault(name, []).append(value)
        with forgoing("the next evaluation writes this one, too"), atomic_write(self.run / EVALUATIONS) as path:
            np.savez(path, **{name: np.array(values) for name, values in self._history.items()})  # type: ignore[arg-type]  # numpy's stubs

        self.logger.record("eval/mean_reward", float(np.mean(evaluation.returns)))
        self.logger.record("eval/mean_ep_length", float(np.mean(evaluation.lengths)))
        for name, values in (
            ("success_rate", evaluation.successes),
            ("normalized_performance", evaluation.normalized_performance),
        ):
            if not np.isnan(np.mean(values)):
                self.logger.record(f"eval/{name}", float(np.mean(values)))
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)


class SaveBestStatistics(BaseCallback):
    """
    Saves the ``VecNormalize`` statistics of each new best model; those at the end of training differ.

    :param path: File to write
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def _on_step(self) -> bool:
        statistics = self.model.get_vec_normalize_env()
        if statistics is not None:
            with atomic_write(self.path) as temporary:
                statistics.save(str(temporary))
        return True


class CheckpointCallback(BaseCallback):
    """
    Saves the model as ``rl_model_<steps>_steps.zip``, and a checkpoint from which a killed run is resumed.

    It saves between two rollouts, when every transition is stored and every update is done. There it also ends training
    after a signal. Networks that hold NaN are not saved.

    :param save_freq: Interval in environment steps; 0 to save only after a signal
    :param run: Folder of the run
    :param env_id: Gymnasium id
    :param stopwatch: Stopwatch of the run
    :param rng_state: States of the random generators to begin with
    :param at_start: Also save a checkpoint before the first step, which makes a finished run an interrupted one
    """

    def __init__(
        self,
        save_freq: int,
        run: str | Path,
        env_id: str,
        stopwatch: Stopwatch,
        rng_state: dict[str, Any] | None = None,
        at_start: bool = False,
    ) -> None:
        super().__init__()
        self.stopwatch = stopwatch
        self.save_freq = save_freq
        self.run = Path(run)
        self.env_id = env_id
        self.rng_state = rng_state
        self.at_start = at_start
        self.stop_requested = False

    def _on_training_start(self) -> None:
        self._n_due = self._count_due()
        if self.rng_state is not None:
            set_rng_state(self.rng_state, self.model.action_space)

    def _on_rollout_start(self) -> None:
        if self.at_start:
            self.at_start = False
            self._save_checkpoint()
        due = self._count_due() > self._n_due
        if (due or self.stop_requested) and has_diverged(self.model):
            raise UserError("the networks hold NaN")
        if due:
            self._n_due = self._count_due()
            with (
                forgoing("this file will be missing"),
                atomic_write(self.run / intermediate_model(self.model.num_timesteps)) as path,
            ):
                self.model.save(path)
            self._save_checkpoint()
        if self.stop_requested:
            self._save_checkpoint()
            raise KeyboardInterrupt

    def _save_checkpoint(self) -> None:
        with forgoing("it can be resumed from the checkpoint before"):
            save_checkpoint(self.model, self.run, self.env_id, self.stopwatch.seconds())

    def _on_step(self) -> bool:
        return True

    def _count_due(self) -> int:
        return self.model.num_timesteps // self.save_freq if self.save_freq > 0 else 0

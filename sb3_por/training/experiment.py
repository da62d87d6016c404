"""One run of train.py: the RL Zoo's ExperimentManager with evaluation, checkpoints and messages of ours."""

import glob
import os
import shlex
import shutil
import signal
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import get_latest_run_id
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecNormalize

import softbody_envs  # noqa: F401  (registers its ids)
from sb3_por.common import plain
from sb3_por.common.errors import UserError, UserNote, one_line
from sb3_por.common.files import DISK_ERRORS, DiskError, atomic_write, remove_unfinished
from sb3_por.evaluation.episodes import (
    Episode,
    FixedEpisodes,
    evaluation_episodes,
    has_diverged,
    scene_kwargs,
    training_episodes,
    whole_episodes,
)
from sb3_por.evaluation.loading import quiet_n_steps
from sb3_por.runs.checkpoints import (
    MODEL,
    latest_checkpoint,
    read_rng_state,
    read_seconds,
    remove_checkpoints,
    restore_buffer,
    restore_monitors,
)
from sb3_por.runs.environment import TrainingEnvironment, read_normalization, with_ranker
from sb3_por.runs.folder import (
    ARGUMENTS,
    BEST_MODEL,
    BEST_STATISTICS,
    COMMAND,
    EVALUATIONS,
    HYPERPARAMETERS,
    REPLAY_BUFFER,
    STATISTICS,
    TENSORBOARD,
    import_names,
    last_model,
    read_evaluations,
    read_settings,
    run_arguments,
    write_settings,
)
from sb3_por.common.checks import check_types
from sb3_por.runs.lock import lock_folder
from sb3_por.runs.origin import mark_as_own, note_foreign
from sb3_por.training.checks import check_policy, check_settings, check_zoo_settings
from sb3_por.training.callbacks import CheckpointCallback, EvaluationCallback, SaveBestStatistics, Stopwatch
from sb3_por.training.full_disk import PatientLogs, keep_playing
from sb3_por.training.saved_state import check_saved_state
from sb3_por.training.trials import trial_settings
from sb3_por.training.workers import WorkerProcesses
from sb3_por.visual.algorithm import VisualAlgorithm

#: Seed of the episodes by which a search scores a trial; far from those of demonstrations
SEARCH_SEED = 1_000_000


class Experiment(ExperimentManager):
    """The zoo's manager of one run. The docstring of each method names the zoo's behaviour that it changes."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if self.vec_env_class is SubprocVecEnv:
            self.vec_env_class = WorkerProcesses
        self._uuid = kwargs["uuid_str"]
        self._folder_made = False
        self._interrupted = False
        self._resumed_run = Path(self.args.resume) if self.args.resume else None
        self._checkpoint = latest_checkpoint(self._resumed_run) if self._resumed_run else None
        last = self._resumed_run / last_model(self.env_name.gym_id) if self._resumed_run else None
        self._extends = self._checkpoint is None and last is not None and last.is_file()
        start = last if self._extends else self._checkpoint / MODEL if self._checkpoint else None
        if start is not None:
            self.trained_agent = str(start)
            self.continue_training = True
        recorded = run_arguments(self._resumed_run) if self._resumed_run else {}
        #: Whether another number of steps was given than the run had
        self._new_length = bool(recorded) and self.args.n_timesteps not in (-1, recorded.get("n_timesteps"))

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        ``--env-kwargs`` and ``-params env_kwargs:`` add to the file's (the zoo's replace them), also in evaluation. A study
        gives its best trial or the one with a number, 0 included.
        """
        changes = dict(self.custom_hyperparams or {})
        if self.storage and self.study_name and not self.optimize_hyperparameters and self._resumed_run is None:
            changes = trial_settings(self.algo, self.storage, self.study_name, self.trial_id) | changes
        self.trial_id = None
        if self.args.demos:
            changes["demos"] = self.args.demos
        given, self.env_kwargs = {**(changes.pop("env_kwargs", None) or {}), **self.env_kwargs}, {}
        self.custom_hyperparams = changes
        if self._resumed_run is None:
            hyperparams, saved = super().read_hyperparameters()
        else:
            saved = import_names(read_settings(self._resumed_run / self.env_name / HYPERPARAMETERS)) | changes
            hyperparams = dict(saved)
        self.env_kwargs = hyperparams["env_kwargs"] = saved["env_kwargs"] = {**(hyperparams.get("env_kwargs") or {}), **given}
        if self.args.ranker:
            wrappers = with_ranker(saved.get("env_wrapper"), self.args.ranker, self.args.ranker_kwargs)
            hyperparams["env_wrapper"] = saved["env_wrapper"] = wrappers
        if "normalize" in saved:
            hyperparams["normalize"] = saved["normalize"] = read_normalization(saved["normalize"])
            check_types(VecNormalize, saved["normalize"] if isinstance(saved["normalize"], dict) else {})
        scenes = scene_kwargs(self.env_name.gym_id, "train" if self.optimize_hyperparameters else "eval")
        kwargs = whole_episodes(self.env_name.gym_id, self.env_kwargs)
        self.eval_env_kwargs = {**kwargs, **scenes, **(self._eval_env_kwargs_args or {})}
        return hyperparams, saved

    def create_log_folder(self) -> None:
        """Make the folder at once; the zoo makes it later, so that runs started together would share it."""
        if self.trained_agent:
            note_foreign(Path(self.trained_agent))  # before anything in its folder is unpickled
        while self._resumed_run is None:
            run_id = get_latest_run_id(glob.escape(self.log_path), self.env_name) + 1
            self.save_path = os.path.join(self.log_path, f"{self.env_name}_{run_id}{self._uuid}")
            try:
                os.makedirs(self.save_path, exist_ok=False)
                break
            except FileExistsError:
                continue
        if self._resumed_run is not None:
            self.save_path = str(self._resumed_run)
            # Monitor begins its file anew by default.
            self.monitor_kwargs = {**self.monitor_kwargs, "override_existing": self._checkpoint is None and not self._extends}
        self.params_path = os.path.join(self.save_path, self.env_name)
        os.makedirs(self.params_path, exist_ok=True)
        self._folder_made = self._resumed_run is None
        self._lock = lock_folder(Path(self.save_path), f"another process is at work in {self.save_path}")
        if self._resumed_run is None:
            mark_as_own(Path(self.save_path))
        else:
            remove_unfinished(self._resumed_run)
            if self._checkpoint is not None:
                restore_monitors(self._resumed_run, self._checkpoint)
        if self.tensorboard_log is None and not self.optimize_hyperparameters:
            self.tensorboard_log = os.path.join(self.save_path, TENSORBOARD)

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """
        Report settings that cannot work in one line, and leave no folder behind. Store in the model what its environment is
        made of, so that its ``.zip`` can be evaluated alone, and its plain description, so that it can be loaded safely.
        """
        try:
            experiment = super().setup_experiment()
            if experiment is not None:
                self._check_evaluation(experiment[0])
            if experiment is not None and self._resumed_run is None:
                self._load_demos(experiment[0])
        except Exception as error:  # of any package, user's module or setting
            if self._folder_made:
                shutil.rmtree(self.save_path, ignore_errors=True)
            if isinstance(error, UserError) or self.verbose > 1:
                raise
            message = f"{self.algo} cannot be set up on {self.env_name.gym_id}: {one_line(error)} (--verbose 2 shows where)"
            raise UserError(message) from error
        if experiment is not None:
            model, settings = experiment
            TrainingEnvironment.of_settings(self.env_name.gym_id, settings).store_in(model)
            setattr(model, plain.ATTRIBUTE, plain.describe(model))
        return experiment

    def _check_evaluation(self, model: BaseAlgorithm) -> None:
        """
        :raises UserError: If evaluation observes something else than training
        """
        for callback in self.callbacks:
            if isinstance(callback, EvaluationCallback):
                seen = BaseAlgorithm._wrap_env(callback.eval_env, verbose=0, monitor_wrapper=False).observation_space
                if seen != model.observation_space:
                    raise UserError(f"--eval-env-kwargs: evaluation observes {seen}, and training {model.observation_space}")

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        Evaluation plays the same episodes each time; the zoo's begin as the training environment does.
        ``VecNormalize`` is the outermost wrapper, since the replay buffer stores what it receives.
        """
        inner, last = self.env_wrapper, FixedEpisodes if eval_env else keep_playing
        self.env_wrapper = last if inner is None else lambda env: last(inner(env))
        try:
            env = super().create_envs(n_envs, eval_env=eval_env, no_log=no_log)
        finally:
            self.env_wrapper = inner
        if eval_env:
            self._deal_out(env)
        return self._normalized(env, eval_env)

    def _normalized(self, env: VecEnv, eval_env: bool) -> VecEnv:
        """The best model has statistics of its own; the zoo takes those of the run's end, or new ones in silence."""
        started = Path(self.trained_agent) if self.trained_agent and self._resumed_run is None else None
        if started is not None:
            folder = started.parent / str(self.env_name)
            best = folder / BEST_STATISTICS
            if started.name == BEST_MODEL and best.is_file():
                normalized = VecNormalize.load(str(best), env)
                if eval_env:
                    normalized.training = normalized.norm_reward = False
                return normalized
            if self.normalize and not eval_env and not (folder / STATISTICS).is_file():
                warnings.warn(f"there are no statistics of observations in {folder}: normalization begins anew", UserNote)
        return super()._maybe_normalize(env, eval_env)

    def _deal_out(self, env: VecEnv) -> None:
        """Give each environment as many of the episodes as SB3 counts of it."""
        episodes, first = self._scored_episodes(), 0
        for index in range(env.num_envs):
            share = (len(episodes) + index) // env.num_envs
            env.env_method("play", episodes[first : first + share], indices=index)
            first += share

    def _scored_episodes(self) -> list[Episode]:
        """Held-out episodes; for a search those of training scenes, so that scores of what it finds are of unseen ones."""
        if self.optimize_hyperparameters:
            return training_episodes(self.env_name.gym_id, self.n_eval_episodes, SEARCH_SEED)
        return evaluation_episodes(self.env_name.gym_id, self.n_eval_episodes)

    def _maybe_normalize(self, env: VecEnv, eval_env: bool) -> VecEnv:
        """Leave it to ``create_envs``; the zoo normalizes inside of the frame stack."""
        return env

    def hyperparameters_optimization(self) -> None:
        """
        Report in one line why a search has failed or was ended, and leave no run's folder behind. The zoo writes its report of
        the finished trials after Ctrl-C; SIGTERM counts as that.
        """

        def interrupt(number: int, frame: Any) -> None:
            self._interrupted = True
            raise KeyboardInterrupt

        handlers = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            super().hyperparameters_optimization()
        except Exception as error:  # of any database's driver, sampler or trial
            if self.verbose > 1:
                raise
            if not self._interrupted:  # else the zoo misses a trial that has ended
                raise UserError(
                    f"the search of {self.algo} has failed: {one_line(error)} (--verbose 2 shows where)"
                ) from error
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
            if self._folder_made:
                shutil.rmtree(self.save_path, ignore_errors=True)
        if self._interrupted:
            raise KeyboardInterrupt(
                "interrupted; with --storage and --study-name, the same command adds to the trials that ended"
            )

    def create_callbacks(self) -> None:
        """Our evaluation and checkpoints, counted in environment steps."""
        for callback in self.callbacks:
            if not isinstance(callback, BaseCallback):
                raise UserError(f"the setting callback names {type(callback).__name__}, which is no callback of SB3")
        if self.show_progress:
            self.callbacks.append(ProgressBarCallback())
        self.callbacks.append(PatientLogs())
        stopwatch = Stopwatch(self._seconds_before())
        if self.eval_freq > 0 and not self.optimize_hyperparameters:
            self.callbacks.append(
                EvaluationCallback(
                    self.create_envs(self.n_eval_envs, eval_env=True),
                    self._scored_episodes(),
                    self.eval_freq,
                    self.save_path,
                    stopwatch,
                    callback_on_new_best=SaveBestStatistics(Path(self.params_path) / BEST_STATISTICS),
                    verbose=self.verbose,
                )
            )
        if not self.optimize_hyperparameters:
            rng_state = read_rng_state(self._checkpoint) if self._checkpoint else None
            self._checkpoints = CheckpointCallback(
                self.save_freq, self.save_path, self.env_name.gym_id, stopwatch, rng_state, at_start=self._extends
            )
            self.callbacks.append(self._checkpoints)

    def _seconds_before(self) -> float:
        """Seconds that a resumed run has taken before."""
        if self._extends and self._resumed_run is not None and (self._resumed_run / EVALUATIONS).is_file():
            return float(read_evaluations(self._resumed_run).get("wall_clock_s", np.zeros(1))[-1])
        return read_seconds(self._checkpoint) if self._checkpoint else 0.0

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        """Restore the replay buffer of a checkpoint, too, and draw other scenes than at the beginning of the run."""
        with quiet_n_steps():
            model = super()._load_pretrained_agent(hyperparams, env)
        check_saved_state(Path(self.trained_agent), model)
        if self._resumed_run is not None:
            self._load_demos(model)  # before the run's settings are written anew
        model.policy.set_training_mode(True)  # a policy that this algorithm cannot train says so now
        if self._checkpoint:
            restore_buffer(model, self._checkpoint)
        buffer = getattr(model, "replay_buffer", None)
        if buffer is not None and buffer.n_envs != env.num_envs:
            raise UserError(f"the replay buffer is of {buffer.n_envs} environments; pass -params n_envs:{buffer.n_envs}")
        if self._extends and buffer is not None and buffer.size() == 0:
            warnings.warn(
                f"{self.save_path} has no {REPLAY_BUFFER}, which --save-replay-buffer writes: training continues with an "
                "empty replay buffer",
                UserNote,
            )
        if self._resumed_run is not None:
            env.seed((self.seed + model.num_timesteps) % 2**32)
        return model

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        """Check them; the zoo takes a word apart."""
        check_zoo_settings(hyperparams)
        schedules: dict[str, Any] = ExperimentManager._preprocess_schedules(hyperparams)
        return schedules

    @staticmethod
    def _load_demos(model: BaseAlgorithm) -> None:
        if isinstance(model, VisualAlgorithm) and model.demos:
            model.load_demos(model.demos)

    def _preprocess_action_noise(self, hyperparams: dict[str, Any], saved: dict[str, Any], env: VecEnv) -> dict[str, Any]:
        """Check the settings; the zoo builds the model next."""
        check_policy(hyperparams.get("policy"), env.observation_space, self.env_name.gym_id)
        arguments: dict[str, Any] = super()._preprocess_action_noise(hyperparams, saved, env)
        check_settings(self.algo, arguments)
        return arguments

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        """Plain YAML; the zoo writes Python objects, which only an unsafe loader reads."""
        write_settings(Path(self.params_path) / HYPERPARAMETERS, dict(sorted(saved_hyperparams.items())))
        write_settings(Path(self.params_path) / ARGUMENTS, dict(sorted({**vars(self.args), "resume": None}.items())))
        if self._resumed_run is None:
            with atomic_write(Path(self.params_path) / COMMAND) as path:
                path.write_text(shlex.join(sys.orig_argv))
        print(f"Log path: {self.save_path}")

    def learn(self, model: BaseAlgorithm) -> None:
        """
        Continue the step count of a resumed run; the zoo's would repeat its schedules and its random warm-up. Ctrl-C and
        SIGTERM end training at the next safe place.
        """
        kwargs: dict[str, Any] = {"callback": self.callbacks, "reset_num_timesteps": not self.continue_training}
        if self.log_interval != -1:
            kwargs["log_interval"] = self.log_interval if self.log_interval > 0 else None
        n_timesteps = self.n_timesteps
        if self._checkpoint or self._extends:  # the total
            total = n_timesteps if self._new_length else max(n_timesteps, model._total_timesteps)
            n_timesteps = max(total - model.num_timesteps, 0)
        handlers = {number: signal.signal(number, self._request_stop) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            model.learn(n_timesteps, **kwargs)
            if has_diverged(model):
                raise UserError("the networks hold NaN")
        except KeyboardInterrupt:
            self._interrupted = True
        except gym.error.Error as error:
            raise UserError(one_line(error)) from error
        except (OSError, ValueError) as error:
            if has_diverged(model):
                reason = one_line(error) if isinstance(error, UserError) else "the networks hold NaN"
                how = self._how_to_resume("-params learning_rate:LOWER")
                raise UserError(f"training diverged before step {model.num_timesteps}: {reason}; {how}") from error
            if isinstance(error, UserError) or getattr(error, "errno", None) in DISK_ERRORS:
                raise UserError(f"step {model.num_timesteps}: {one_line(error)}; {self._how_to_resume()}") from error
            raise
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
            self._close(model)

    def _how_to_resume(self, change: str = "") -> str:
        """The last checkpoint, and the command that resumes from it."""
        checkpoint = latest_checkpoint(Path(self.save_path))
        if checkpoint is None:
            return f"there is no checkpoint yet in {self.save_path}"
        command = f"python train.py --resume {self.save_path} {change}".rstrip()
        return f"the last checkpoint is {checkpoint}, resume from it with: {command}"

    def _request_stop(self, number: int, frame: Any) -> None:
        """
        A signal waits for a safe place, a second Ctrl-C does not. A second SIGTERM changes nothing: a run of a suite gets one
        from the cluster, like every process of the job, and one from the suite.
        """
        if self._checkpoints.stop_requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        self._checkpoints.stop_requested = True

    def _close(self, model: BaseAlgorithm) -> None:
        for callback in self.callbacks:
            if isinstance(callback, ProgressBarCallback) and hasattr(callback, "pbar"):
                callback.pbar.close()
            if isinstance(callback, EvaluationCallback):
                callback.eval_env.close()
        if model.env is not None:
            model.env.close()

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """Write files atomically, say how an interrupted run is resumed, and let go of the folder."""
        try:
            self._finish(model)
        finally:
            # Not when this object is collected: a lock file without the system's help would stay until then
            self._lock.release()

    def _finish(self, model: BaseAlgorithm) -> None:
        """See ``save_trained_model``."""
        message = f"interrupted at step {model.num_timesteps}; resume with: python train.py --resume {self.save_path}"
        if self._interrupted and latest_checkpoint(Path(self.save_path)) is None:
            # A model without a checkpoint is what marks a finished run.
            raise KeyboardInterrupt(message)
        try:
            self._write_model(model)
        except DiskError as error:
            raise UserError(f"{error}; {self._how_to_resume()}") from error
        print(f"Saved to {self.save_path}")
        if self._interrupted:
            raise KeyboardInterrupt(message)
        remove_checkpoints(Path(self.save_path))

    def _write_model(self, model: BaseAlgorithm) -> None:
        """Write the last model last: it marks a finished run."""
        save: Callable[[Path], Any] = model.save
        statistics = model.get_vec_normalize_env()
        if statistics is not None:
            with atomic_write(Path(self.params_path) / STATISTICS) as path:
                statistics.save(str(path))
        if self.save_replay_buffer and hasattr(model, "save_replay_buffer"):
            with atomic_write(Path(self.save_path) / REPLAY_BUFFER) as path:
                model.save_replay_buffer(path)
        with atomic_write(Path(self.save_path) / last_model(str(self.env_name))) as path:
            save(path)

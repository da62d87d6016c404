"""Set-up, saving and loading of the visual algorithms."""

import io
import pathlib
import sys
import warnings
from typing import Any, ClassVar

import torch as th
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_por.acceleration.overlap import OverlappedTraining
from sb3_por.acceleration.precision import check_precision
from sb3_por.acceleration.updates import AcceleratedUpdates
from sb3_por.common import plain
from sb3_por.common.checks import check_ranges, check_types
from sb3_por.common.errors import UserError, UserNote
from sb3_por.common.random_state import SavedRandomState
from sb3_por.common.running_means import RunningMeans
from sb3_por.demonstrations.dataset import Demonstrations, describe
from sb3_por.demonstrations.playback import fill, n_transitions
from sb3_por.objectives.base import Objective
from sb3_por.visual.balance import GradientBalance, gradient_ratio
from sb3_por.visual.batch import Augmentation
from sb3_por.visual.made_of import made_of
from sb3_por.visual.normalization import transpose_inside
from sb3_por.visual.replay_buffer import SequenceReplayBuffer
from sb3_por.visual.symmetries import check_planar

MAX = sys.float_info.max
#: Smallest and largest value of each numeric argument
RANGES: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("tau", "encoder_tau", "gamma"), (0, 1)),
    **dict.fromkeys(("buffer_size", "batch_size", "n_steps", "train_freq", "stats_window_size"), (1, MAX)),
    **dict.fromkeys(("actor_update_interval", "target_update_interval", "diagnostics_interval"), (1, MAX)),
    **dict.fromkeys(("n_augmentations", "n_target_augmentations"), (1, MAX)),
    **dict.fromkeys(("learning_rate", "learning_starts", "augmentation_pad", "por_coef"), (0, MAX)),
    **dict.fromkeys(("ent_coef_lr_ratio", "aux_lr_ratio", "ent_coef"), (0, MAX)),
    "gradient_steps": (-1, MAX),
    "bc_coef": (0, MAX),
    "reward_scale": (-MAX, MAX),
}


class VisualAlgorithm(OverlappedTraining, SavedRandomState):
    """
    A mixin for SB3's off-policy actor-critics (SAC, TQC): builds what an update needs, and refuses what does not fit. The
    update itself is ``VisualActorCritic``'s.
    """

    #: The auxiliary objective; None for none
    objective_class: ClassVar[type[Objective] | None] = None
    #: Default of ``encoder_tau``, in units of ``tau``
    encoder_tau_ratio: ClassVar[float] = 1.0

    #: Replay buffer of the demonstrations; None for none
    demo_buffer: Any = None

    #: Learning rate of an objective that has an optimizer of its own, in units of ``learning_rate``
    aux_lr_ratio: float = 1.0

    # Set by the subclass's constructor, which documents them
    encoder_tau: float | None
    actor_update_interval: int
    ent_coef_lr_ratio: float
    reward_scale: float
    start_at_mean_reward: bool
    augmentation_pad: int
    n_augmentations: int
    n_target_augmentations: int
    planar_actions: list[Any] | None
    diagnostics_interval: int
    demos: str | None
    bc_coef: float
    precision: str
    compile_mode: str | None

    #: Saved, so that a model alone can be evaluated in the same; see ``made_of``
    environment_made_of: dict[str, Any] | None = None

    # What SAC and TQC have in common
    policy: Any
    actor: Any
    replay_buffer: Any
    replay_buffer_class: Any
    critic: Any
    critic_target: Any
    ent_coef_optimizer: Any
    log_ent_coef: Any
    ent_coef_tensor: th.Tensor
    target_entropy: Any
    target_update_interval: int
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]]
    batch_norm_stats: list[th.Tensor]
    batch_norm_stats_target: list[th.Tensor]

    def _setup_model(self) -> None:
        self._check_arguments()
        if self.start_at_mean_reward and self.gamma >= 1.0:
            raise ValueError("start_at_mean_reward needs gamma < 1: without a discount, the sum of all rewards is infinite")
        self._check_class()
        # The objective's arguments are attributes of the same names, so that load(path, k=3) changes them, as in SB3
        names = [] if self.objective_class is None else self.objective_class.arguments()
        objective = {
            "objective_class": self.objective_class,
            "objective_kwargs": {name: getattr(self, name) for name in names},
        }
        self.policy_kwargs = {**self.policy_kwargs, **objective}
        if self.replay_buffer_class is None:
            self.replay_buffer_class = SequenceReplayBuffer
        own_buffer = issubclass(self.replay_buffer_class, SequenceReplayBuffer)
        given = self.replay_buffer_kwargs
        self.replay_buffer_kwargs = self._buffer_arguments()
        with warnings.catch_warnings():
            if own_buffer:
                # SB3 knows its own buffers only
                warnings.filterwarnings("ignore", message="`n_steps=")
            super()._setup_model()
        self.replay_buffer_kwargs = given  # what is saved, and perhaps loaded with another kind of buffer
        if own_buffer:
            # If set, SB3 would end the episode that a second learn() cuts off
            self.optimize_memory_usage = False
        self._check_buffer()
        if self.planar_actions is not None:
            check_planar(self.planar_actions, self.observation_space, self.action_space)
        self.policy.is_trained_here = True
        self._acceleration = AcceleratedUpdates(self.policy, self.precision, self.compile_mode)
        self._augmentation = Augmentation(self.policy, self.augmentation_pad)
        self._balance = GradientBalance(self._gradient_ratio(), self.device)
        self._metrics = RunningMeans()
        # In the .zip, from which a stranger rebuilds the model without pickled code
        setattr(self, plain.ATTRIBUTE, plain.describe(self))

    def _buffer_arguments(self) -> dict[str, Any]:
        """The replay buffer's arguments; our own computes the returns, too."""
        own = issubclass(self.replay_buffer_class, SequenceReplayBuffer)
        return self.replay_buffer_kwargs | ({"n_steps": self.n_steps, "gamma": self.gamma} if own else {})

    def _check_arguments(self) -> None:
        """
        :raises TypeError: If an argument has the wrong type
        :raises ValueError: If a number is out of its range
        """
        # Not those that SB3 has replaced by objects
        values = {name: value for name, value in vars(self).items() if name not in ("env", "policy", "device")}
        check_types(type(self), values)
        check_ranges(values, RANGES)
        check_precision(self.precision)
        self._gradient_ratio()

    @property
    def objective_coef(self) -> str | float:
        """
        :return: Weight lambda of the objective's loss, or the ratio of gradients that it keeps, such as ``"auto_0.1"``
        """
        return 1.0

    def _gradient_ratio(self) -> float | None:
        """
        :return: The ratio that ``objective_coef`` names; None if it is a number
        :raises ValueError: If it is neither, or if there is nothing to balance
        """
        objective = self.objective_class
        named = (
            "objective_coef" if objective is None or not hasattr(self, f"{objective.name}_coef") else f"{objective.name}_coef"
        )
        ratio = gradient_ratio(self.objective_coef, named)
        if ratio is not None and objective is not None and objective.own_optimizer:
            raise ValueError(
                f"{named} cannot balance gradients: {objective.__name__} has an optimizer of its own, whose steps do not "
                "depend on the weight of the loss; use aux_lr_ratio"
            )
        return ratio

    def _check_class(self) -> None:
        """
        :raises ValueError: If a loaded model was saved by a class with another critic or another objective
        """
        policy_class = self.policy_aliases["MlpPolicy"]
        if not issubclass(self.policy_class, policy_class):
            raise ValueError(f"{type(self).__name__} needs a {policy_class.__name__}, not a {self.policy_class.__name__}")
        trained = self.policy_kwargs.get("objective_class", self.objective_class)
        if trained is not self.objective_class:
            names = [
                "no objective" if one is None else f"the objective {one.__name__}" for one in (trained, self.objective_class)
            ]
            raise ValueError(
                f"{type(self).__name__} has {names[1]}, and this model was trained with {names[0]}: load it with the class "
                "that saved it. To start one method from the encoder of another, make a new model and call its load_encoder()."
            )

    def _check_buffer(self) -> None:
        """
        :raises ValueError: If the replay buffer cannot sample the frames that the objective uses
        """
        objective, buffer = self.policy.objective, self.replay_buffer
        if objective is None or isinstance(buffer, SequenceReplayBuffer):
            return
        next_is_future = not (isinstance(buffer, NStepReplayBuffer) and buffer.n_steps > 1)
        has_future = objective.future is None or (objective.future == (1, 1) and next_is_future)
        if objective.window > 0 or not has_future:
            raise ValueError(
                f"{type(buffer).__name__} cannot sample the later frames that {type(self).__name__} needs with these "
                "settings: use the default replay_buffer_class, SequenceReplayBuffer."
            )

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Any:
        """
        :param total_timesteps: Number of environment steps
        :param callback: Called at every step
        :param log_interval: Log every ``log_interval`` episodes
        :param tb_log_name: Name of the run in TensorBoard; the name of the class by default
        :param reset_num_timesteps: Start counting from zero. False continues; a loaded model as if it had never stopped
        :param progress_bar: Show a progress bar
        :return: The model
        """
        if vars(self).get(plain.LACKS_VALUES):
            raise UserError("an exported agent only plays: it holds no Q networks; to train on, take the model of its run")
        self.environment_made_of = made_of(self.env)
        name = type(self).__name__ if tb_log_name is None else tb_log_name
        if self.demos is not None and self.demo_buffer is None:
            self.load_demos(self.demos)
        if self.bc_coef > 0 and self.demo_buffer is None:
            warnings.warn("bc_coef has no effect without demonstrations: give demos, or train.py --demos", UserNote)
        return super().learn(total_timesteps, callback, log_interval, name, reset_num_timesteps, progress_bar)

    @classmethod
    def load(cls, path: Any, *args: Any, **kwargs: Any) -> Any:
        """
        :param path: As all else, SB3's
        :return: The model
        :raises UserError: If the file holds no pickled code, and so neither the spaces that SB3 asks for
        """
        try:
            return super().load(path, *args, **kwargs)
        except KeyError as error:
            if "observation_space" not in str(error):
                raise
            raise UserError(f"{path} was exported without pickled code: load it with sb3_por.evaluation.load_safe") from error

    @staticmethod
    def _wrap_env(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        return OffPolicyAlgorithm._wrap_env(transpose_inside(env), verbose, monitor_wrapper)

    def load_encoder(self, other: "VisualAlgorithm") -> None:
        """
        Start from the encoder of another model, also of another method; everything else stays as it is.

        :param other: Model with an encoder of the same shape
        :raises ValueError: If the encoder has another shape
        """
        own, given = ((one.critic.features_extractor, one.critic.projection) for one in (self, other))
        for mine, theirs in zip(own, given, strict=True):
            if str(mine) != str(theirs):  # layers with their shapes and strides
                raise ValueError(f"the encoder of {type(other).__name__} has another shape: {theirs} instead of {mine}")
        if self.policy.normalize_images != other.policy.normalize_images:
            raise ValueError(f"the encoder of {type(other).__name__} sees images in another range (normalize_images)")
        for critic in (self.critic, self.critic_target):
            critic.features_extractor.load_state_dict(given[0].state_dict())
            critic.projection.load_state_dict(given[1].state_dict())

    def load_demos(self, path: str | pathlib.Path) -> None:
        """
        Draw half of each batch from demonstrations. ``learn()`` does so for the folder that ``demos`` names.

        :param path: Folder of a Minari dataset whose episodes were played in the training environment
        :raises UserError: If it cannot be read, or does not fit
        """
        if issubclass(self.replay_buffer_class, HerReplayBuffer):
            raise UserError("demonstrations cannot be relabelled: HerReplayBuffer and demos exclude each other")
        if self.batch_size < 2:
            raise UserError("half of each batch comes from the demonstrations: batch_size must be at least 2")
        demonstrations, own = Demonstrations(path), self.replay_buffer
        buffer = self.replay_buffer_class(
            n_transitions(demonstrations),
            own.observation_space,
            own.action_space,
            device=self.device,
            n_envs=1,
            optimize_memory_usage=self.optimize_memory_usage,
            **self._buffer_arguments(),
        )
        fill(buffer, demonstrations)
        self._compare_environments(demonstrations.spec)
        self.demos, self.demo_buffer = str(path), buffer

    def _compare_environments(self, recorded: EnvSpec | None) -> None:
        """Note it if demonstrations are from an environment whose actions or rewards may mean something else."""
        trained: EnvSpec | None = self.env.get_attr("spec", 0)[0] if self.env is not None else None
        if recorded is not None and trained is not None and describe(recorded) != describe(trained):
            warnings.warn(
                f"the demonstrations were made in {describe(recorded)}, and training is in {describe(trained)}: actions and "
                "rewards may mean something else",
                UserNote,
            )

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        :param path: File that ``save_replay_buffer()`` wrote
        :param truncate_last_traj: See SB3
        :raises ValueError: If the buffer is of another kind, or was filled with other environments or other returns
        """
        own = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        loaded = self.replay_buffer
        for name in ("n_envs", "observation_space", "action_space", "n_steps", "gamma"):
            values = [getattr(buffer, name, None) for buffer in (loaded, own)]
            if type(loaded) is not type(own) or values[0] != values[1]:
                self.replay_buffer = own
                differs = (
                    ("kind", type(loaded).__name__, type(own).__name__) if type(loaded) is not type(own) else (name, *values)
                )
                raise ValueError("the {} of the replay buffer in the file is {}, and this model's is {}".format(*differs))
        if loaded.buffer_size != own.buffer_size:
            sizes = [buffer.buffer_size * buffer.n_envs for buffer in (loaded, own)]
            warnings.warn(
                "the replay buffer in the file holds {} transitions, and buffer_size {} has no effect".format(*sizes), UserNote
            )

    def get_parameters(self) -> dict[str, Any]:
        """
        :return: SB3's names and state dicts. The state of an objective's own optimizer is a part of the critic's optimizer, so
            that SB3's class finds the names that it expects
        """
        parameters = super().get_parameters()
        if self.policy.objective_optimizer is not None:
            parameters["critic.optimizer"]["objective"] = self.policy.objective_optimizer.state_dict()
        return parameters

    def set_parameters(
        self, load_path_or_dict: str | dict[str, Any], exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """
        :param load_path_or_dict: What ``get_parameters()`` returned, or the path of a model
        :param exact_match: Whether all parameters must be there
        :param device: PyTorch device
        :raises ValueError: If parameters are missing, or of other names
        """
        if isinstance(load_path_or_dict, dict):
            parameters: dict[str, Any] = load_path_or_dict
        else:
            parameters = load_from_zip_file(load_path_or_dict, device=device, load_data=False)[1]
        super().set_parameters(parameters, exact_match, device)
        if self.policy.objective_optimizer is None:
            return
        state = parameters.get("critic.optimizer", {}).get("objective")
        if state is not None:
            self.policy.objective_optimizer.load_state_dict(state)
        elif exact_match:
            raise ValueError("the state of the objective's optimizer is missing in the one of critic.optimizer")

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_metrics", "_augmentation", "_acceleration", "_balance", "demo_buffer"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        return state_dicts, [*variables, "_balance.norms"] if self._balance.ratio is not None else variables

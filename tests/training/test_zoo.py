"""train.py: the zoo's command with our algorithms, tasks, evaluation and messages."""

import argparse
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import optuna
import pytest
import rl_zoo3
import yaml
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from rl_zoo3.utils import get_saved_hyperparams, get_trained_models
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

from sb3_por import ALGORITHMS
from sb3_por.__main__ import main as evaluation_main
from sb3_por.analysis.scores import read_scores
from sb3_por.common.errors import UserError
from sb3_por.evaluation.episodes import FixedEpisodes
from sb3_por.evaluation.loading import load_model
from sb3_por.runs.facts import run_identity
from sb3_por.training.arguments import Settings
from sb3_por.training.checks import check_policy
from sb3_por.training.experiment import Experiment
from sb3_por.training.hyperparameters import hyperparameter_file
from sb3_por.training.zoo import main
from softbody_envs import ENV_IDS
from softbody_envs.variations import SPLITS

ROOT = Path(__file__).parents[2]
PENDULUM = ["--algo", "sac", "--env", "Pendulum-v1", "--eval-episodes", "2", "--seed", "1", "--num-threads", "1"]
SMALL = ["-params", "learning_starts:50", "buffer_size:1000", "batch_size:16"]


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory):
    """A run of SAC on Pendulum: 400 steps, evaluated at 150, 300 and the end, a checkpoint at 200."""
    folder = tmp_path_factory.mktemp("logs")
    flags = ["-n", "400", "--eval-freq", "150", "--save-freq", "200", "--save-replay-buffer", "-f", str(folder)]
    assert main([*PENDULUM, *flags, *SMALL]) == 0
    return folder / "sac" / "Pendulum-v1_1"


def test_a_run_leaves_the_zoos_files(finished_run):
    files = {str(path.relative_to(finished_run)) for path in finished_run.rglob("*") if path.is_file()}
    assert files >= {
        "0.monitor.csv",
        "Pendulum-v1.zip",
        "best_model.zip",
        "evaluations.npz",
        "replay_buffer.pkl",
        "rl_model_200_steps.zip",
        "Pendulum-v1/args.yml",
        "Pendulum-v1/config.yml",
        "Pendulum-v1/command.txt",
    }
    assert list(finished_run.glob("tb/SAC_1/events*"))
    assert {name for name in files if "/." in f"/{name}"} <= {".lock", ".origin"}
    assert not (finished_run / "checkpoint").exists()
    assert load_model(finished_run / "Pendulum-v1.zip").num_timesteps == 400


def test_settings_are_plain_yaml_that_the_zoo_reads(finished_run):
    args = yaml.safe_load((finished_run / "Pendulum-v1" / "args.yml").read_text())
    assert (args["algo"], args["env"], args["seed"], args["n_timesteps"]) == ("sac", "Pendulum-v1", 1, 400)
    assert "cores of" in args["machine"] and "PyTorch" in args["machine"]
    config = yaml.safe_load((finished_run / "Pendulum-v1" / "config.yml").read_text())
    assert config["learning_starts"] == 50 and config["policy"] == "MlpPolicy"
    assert get_trained_models(str(finished_run.parent.parent)) == {"sac-Pendulum-v1": ("sac", "Pendulum-v1")}
    assert get_saved_hyperparams(str(finished_run / "Pendulum-v1"))[0]["normalize"] is False


def test_the_command_can_be_typed_again(tmp_path, monkeypatch):
    typed = [
        "python",
        "train.py",
        *PENDULUM,
        "-params",
        "env_wrapper:[{'gymnasium.wrappers.TimeLimit': {'max_episode_steps': 9}}]",
    ]
    monkeypatch.setattr(sys, "orig_argv", typed)
    assert main([*typed[2:-2], "-n", "10", "--eval-freq", "0", "-f", str(tmp_path)]) == 0
    assert shlex.split((tmp_path / "sac" / "Pendulum-v1_1" / "Pendulum-v1" / "command.txt").read_text()) == typed


def test_evaluations_are_regular_and_include_the_end(finished_run):
    with np.load(finished_run / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == [150, 300, 400]
        assert file["results"].shape == file["ep_lengths"].shape == file["normalized_performance"].shape == (3, 2)
        assert (file["ep_lengths"] == 200).all() and (np.diff(file["wall_clock_s"]) > 0).all()
        best = file["results"].mean(axis=1).argmax()
    assert load_model(finished_run / "best_model.zip").num_timesteps == [150, 300, 400][best]
    rows = read_scores([finished_run])
    assert rows["algo"].tolist() == ["sac"] * 3 and rows["seed"].tolist() == [1] * 3


def test_a_resumed_run_goes_on_counting_without_a_second_warm_up(finished_run, tmp_path, monkeypatch):
    sampled = []
    original = SAC._sample_action

    def sample(self, learning_starts, *args, **kwargs):
        sampled.append(self.num_timesteps < learning_starts)
        return original(self, learning_starts, *args, **kwargs)

    monkeypatch.setattr(SAC, "_sample_action", sample)
    flags = ["-n", "60", "--eval-freq", "-1", "-i", str(finished_run / "Pendulum-v1.zip"), "-f", str(tmp_path)]
    assert main([*PENDULUM, *flags, "--label", "warm", *SMALL]) == 0
    run = tmp_path / "sac" / "Pendulum-v1_1"
    assert run_identity(run) == {"env": "Pendulum-v1", "algo": "warm", "seed": 1}
    model = load_model(run / "Pendulum-v1.zip")
    assert model.num_timesteps == 460 and model._total_timesteps == 460
    assert len(sampled) == 60 and not any(sampled)


def test_a_run_that_begins_with_a_model_has_a_seed_of_its_own(tmp_path, monkeypatch):
    model = ALGORITHMS["sac_por"]("MlpPolicy", "Pendulum-v1", buffer_size=100, learning_starts=10, batch_size=8)
    model.learn(20).save(tmp_path / "model.zip")
    restored = []
    monkeypatch.setattr("sb3_por.common.random_state.set_rng_state", lambda *state: restored.append(state))
    flags = ["-n", "10", "--eval-freq", "-1", "--env", "Pendulum-v1", "-i", str(tmp_path / "model.zip"), "-f", str(tmp_path)]
    assert main(["--algo", "sac_por", *flags, "-params", "policy:MlpPolicy", "learning_starts:10", "batch_size:8"]) == 0
    assert restored == []


def test_env_kwargs_add_to_the_files_and_reach_the_evaluation(tmp_path, monkeypatch):
    made = []
    original = gym.envs.registration.EnvSpec.make
    monkeypatch.setattr(
        gym.envs.registration.EnvSpec, "make", lambda spec, **kwargs: made.append(kwargs) or original(spec, **kwargs)
    )
    flags = ["--algo", "sac", "-n", "20", "--eval-freq", "20", "--eval-episodes", "1", "-f", str(tmp_path)]
    assert main([*flags, "--env-kwargs", "renderer:tiny", "max_episode_steps:5", "--seed", "1"]) == 0
    train, held_out = sorted(made, key=lambda kwargs: "split" in kwargs)
    assert train == {"obs_type": "state", "renderer": "tiny", "max_episode_steps": 5}
    assert held_out == {"obs_type": "state", "renderer": "tiny", "split": "eval"}  # whole episodes
    with np.load(tmp_path / "sac" / "PourWater-v0_1" / "evaluations.npz") as file:
        assert np.isfinite(file["normalized_performance"]).all() and file["successes"].shape == (1, 1)


def test_runs_started_together_get_folders_of_their_own(tmp_path, monkeypatch):
    """As seen by two runs of which the second looks for a free number before the first has made its folder."""
    experiments = [Experiment.__new__(Experiment) for _ in range(2)]
    monkeypatch.setattr("sb3_por.training.experiment.get_latest_run_id", lambda *_: numbers.pop(0))
    numbers = [0, 0, 1]
    for experiment in experiments:
        experiment.log_path, experiment.env_name, experiment._uuid = str(tmp_path), "E-v0", ""
        experiment.tensorboard_log, experiment.optimize_hyperparameters, experiment._resumed_run = None, False, None
        experiment.trained_agent = ""
        experiment.create_log_folder()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["E-v0_1", "E-v0_2"]
    assert experiments[1].tensorboard_log == str(tmp_path / "E-v0_2" / "tb")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--algo", "sac_poor"], "unknown algorithm 'sac_poor'; did you mean sac_por?"),
        (["--env", "pourwater-v0"], "unknown environment 'pourwater-v0'; did you mean PourWater-v0?"),
        (["--nonsense"], "unrecognized arguments: --nonsense"),
        (["--algo", "sac", "--env", "CartPole-v1"], "action spaces but Discrete(2) was provided"),
        (["--algo", "sac", "-params", "policy:CnnPolicy"], "pass -params policy:MlpPolicy"),
        (["--algo", "sac", "-params", "colour:blue"], "unknown setting of sac 'colour'; no name is near it"),
        (["--algo", "sac", "-params", "learning_rate"], "-params takes key:value pairs, got 'learning_rate'"),
        (["--algo", "sac", "--env-kwargs", "obs_type:sound"], "obs_type must be one of pixels, state, dict, got 'sound'"),
        (["--algo", "sac", "-conf", "missing.yml"], "cannot read missing.yml"),
        (["--algo", "sac", "-i", "missing.zip"], "there is no model missing.zip"),
        (["--algo", "sac", "-i", __file__], "corrupt or no .zip at all"),
        (["--gym-packages", "no_such_package"], "No module named 'no_such_package'"),
        (["--gym-packages", ""], "cannot import the package : Empty module name"),
        (["-f", "/proc/logs"], "cannot write in /proc/logs"),
        (["-f", ""], "-f needs the name of a folder"),
        (["-tb", "/proc/tb"], "cannot write in /proc/tb"),
        (["-n", "0"], "--n-timesteps must be at least 1, got 0"),
        (["--eval-episodes", "0"], "--eval-episodes must be at least 1, got 0"),
        (["--label", "por/paper"], "--label names files: it may hold no slashes, got por/paper"),
        (["--n-eval-envs", "-1"], "--n-eval-envs must be at least 1, got -1"),
        (["--seed", str(2**32)], "--seed must be between 0 and 4294967295"),
        (["--num-threads", "-2"], "--num-threads must be at least 1, got -2"),
        (["-optimize", "--n-trials", "0"], "--n-trials must be at least 1, got 0"),
        (["-optimize", "--n-trials", "1", "--storage", "/proc/study.log"], "No such file or directory: '/proc/study.log'"),
        (
            ["--algo", "sac", "-params", "learning_start:5"],
            "unknown setting of sac 'learning_start'; did you mean learning_starts?",
        ),
        (["--algo", "sac", "-params", "batch_size:fast"], "batch_size must be int, got 'fast'"),
        (["--algo", "sac", "-params", "gamma:-1"], "gamma must be between 0 and 1, got -1"),
        (["--algo", "sac", "-params", "train_freq:(0,'episode')"], "train_freq must be a finite number of at least 1, got 0"),
        (["--algo", "sac", "-params", "action_noise:normal"], "noise.ActionNoise | None, got 'normal'"),
        (["--algo", "sac", "-params", "normalize:{'gamma':'x'}"], "gamma must be float, got 'x'"),
        (["--algo", "sac", "-params", "normalize:open('x')"], "-params normalize:open('x'): FileNotFoundError"),
        (["--algo", "sac", "-params", "normalize:often"], "normalize must be True, False or arguments of VecNormalize"),
        (["--algo", "sac", "-params", "gamma:1/0"], "-params gamma:1/0: ZeroDivisionError: division by zero"),
        (["--algo", "sac", "-params", "gamma:exit()"], "-params gamma:exit(): SystemExit"),
        (["--algo", "sac", "-params", "callback:builtins.dict"], "callback names dict, which is no callback"),
        (["--algo", "sac", "-params", "env_wrapper:no_such.Wrapper"], "No module named 'no_such'"),
        (["--algo", "sac", "-params", "policy_kwargs:'dict('"], "was never closed"),
        (["--algo", "sac", "-params", "learning_rate:1e-3x"], "learning_rate must be a number, or lin_NUMBER"),
        (
            ["--algo", "sac", "-params", "n_envs:2", "train_freq:(1,'episode')"],
            "train_freq in episodes needs one environment",
        ),
        (["--algo", "sac", "-params", "n_timesteps:0"], "n_timesteps must be a whole number of at least 1, got 0"),
        (["--algo", "sac", "-params", "n_envs:0"], "n_envs must be a whole number of at least 1, got 0"),
        (["--algo", "sac", "-params", "frame_stack:2.0"], "frame_stack must be a whole number of at least 1, got 2.0"),
        (["--algo", "sac", "-params", "noise_type:normal"], "noise_type needs noise_std"),
        (["--algo", "sac", "-params", "seed:3"], "the seed is a flag: --seed"),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_run(flags, message, tmp_path, capsys):
    assert main(["-n", "10", "-f", str(tmp_path), *flags]) == 2
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines if line.startswith("train.py: error: ")]
    assert len(said) == 1 and said == lines[-1:] and message in said[0]
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert not list(tmp_path.glob("*/*_*"))


def test_a_gpu_that_is_not_there_is_said(capsys, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert main([*PENDULUM, "--device", "cuda"]) == 2
    assert "--device cuda: PyTorch finds no CUDA device here" in capsys.readouterr().err


def test_more_evaluation_environments_than_episodes_play_these(tmp_path):
    flags = ["-n", "10", "--eval-freq", "5", "--n-eval-envs", "3", "-f", str(tmp_path)]
    assert main([*PENDULUM, *flags, *SMALL]) == 0
    with np.load(tmp_path / "sac" / "Pendulum-v1_1" / "evaluations.npz") as file:
        assert file["results"].shape == (2, 2)


def test_a_search_leaves_its_report_and_no_run(tmp_path, capsys):
    flags = ["-optimize", "--n-trials", "1", "--no-optim-plots", "--n-evaluations", "1", "-n", "60", "-f", str(tmp_path)]
    assert main([*PENDULUM, *flags, *SMALL]) == 0
    assert {path.suffix for path in (tmp_path / "sac").iterdir()} == {".csv", ".pkl"}
    assert main(["--resume", str(tmp_path), "-optimize"]) == 2


@pytest.mark.parametrize(("number", "n_ended"), [(signal.SIGTERM, 2), (signal.SIGINT, 0)])
def test_a_search_that_is_told_to_end_keeps_the_trials_that_have_ended(number, n_ended, tmp_path, monkeypatch, capsys):
    score, trials = Experiment._scored_episodes, []

    def tell(experiment):
        trials.append(experiment)
        if len(trials) > n_ended:
            os.kill(os.getpid(), number)
            time.sleep(0.01)
        return score(experiment)

    monkeypatch.setattr(Experiment, "_scored_episodes", tell)
    file = str(tmp_path / "study.log")
    flags = ["-optimize", "--n-trials", "9", "--no-optim-plots", "--n-evaluations", "1", "-n", "60", "-f", str(tmp_path)]
    assert main([*PENDULUM, *flags, "--storage", file, "--study-name", "s", *SMALL]) == 130
    assert capsys.readouterr().err.splitlines()[-1].startswith("train.py: interrupted; with --storage and --study-name, ")
    study = optuna.load_study(study_name="s", storage=JournalStorage(JournalFileBackend(file)))
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"] * n_ended + ["FAIL"]
    reports = list((tmp_path / "sac").glob("report_*.csv")) if n_ended else []
    assert len(reports) == (n_ended > 0)


def test_a_search_does_not_see_the_held_out_episodes(tmp_path, monkeypatch):
    played, play = [], FixedEpisodes.play

    def note(env, episodes):
        played.append((env.unwrapped.split, episodes))
        play(env, episodes)

    monkeypatch.setattr(FixedEpisodes, "play", note)
    state = ["--algo", "sac", "--env", "PourWater-v0", "-n", "60", "--eval-episodes", "3", "-f", str(tmp_path), *SMALL]
    assert main([*state, "-optimize", "--n-trials", "1", "--no-optim-plots", "--n-evaluations", "1"]) == 0
    assert main([*state, "--eval-freq", "1000"]) == 0
    (split, searched), (held_out_split, held_out), *_ = played
    assert (split, held_out_split) == ("train", "eval")
    for split, episodes in (("train", searched), ("eval", held_out)):
        assert {one.variation for one in episodes} <= set(SPLITS[split])
    assert len(searched) == 3 and not {one.seed for one in searched} & {one.seed for one in held_out}


def test_a_search_deals_its_episodes_out(tmp_path, monkeypatch):
    seen, reset = [], FixedEpisodes.reset

    def note(env, **how):
        result = reset(env, **how)
        seen.append((id(env), env._current.seed))
        return result

    monkeypatch.setattr(FixedEpisodes, "reset", note)
    flags = ["-optimize", "--n-trials", "1", "--no-optim-plots", "--n-evaluations", "1", "-n", "60", "-f", str(tmp_path)]
    assert main([*PENDULUM, "--eval-episodes", "5", "--n-eval-envs", "2", *flags, *SMALL]) == 0
    shares = [{seed - 2_000_000 for one, seed in seen if one == env} for env in dict.fromkeys(env for env, _ in seen)]
    assert shares == [{0, 1}, {2, 3, 4}]


def test_training_that_diverges_is_one_line_and_keeps_the_checkpoints(tmp_path, capsys):
    flags = ["-n", "300", "--eval-freq", "60", "--save-freq", "60", "-f", str(tmp_path)]
    small = ["-params", "learning_starts:70", "buffer_size:1000", "batch_size:16", "learning_rate:1e30"]
    assert main([*PENDULUM, *flags, *small]) == 2
    assert "diverged" in capsys.readouterr().err.splitlines()[-1]
    run = tmp_path / "sac" / "Pendulum-v1_1"
    assert load_model(run / "rl_model_60_steps.zip").num_timesteps == 60
    assert load_model(run / "best_model.zip").num_timesteps == 60


def test_ctrl_c_saves_and_says_how_to_go_on(tmp_path, capsys, monkeypatch):
    class Interrupt(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 130:
                os.kill(os.getpid(), signal.SIGINT)
            return True

    create = Experiment.create_callbacks
    monkeypatch.setattr(Experiment, "create_callbacks", lambda self: (create(self), self.callbacks.append(Interrupt())))
    assert main([*PENDULUM, "-n", "160", "--eval-freq", "80", "-f", str(tmp_path), *SMALL]) == 130
    run = tmp_path / "sac" / "Pendulum-v1_1"
    last_line = capsys.readouterr().err.splitlines()[-1]
    assert last_line == f"train.py: interrupted at step 130; resume with: python train.py --resume {run}"
    assert load_model(run / "Pendulum-v1.zip").num_timesteps == 130
    monkeypatch.undo()
    assert main(["--resume", str(run)]) == 0
    assert load_model(run / "Pendulum-v1.zip").num_timesteps == 160
    with np.load(run / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == [80, 160]


def test_settings_are_ours_then_the_zoos_then_our_default():
    ours, zoo = ROOT / "zoo_hyperparams", Path(rl_zoo3.__file__).parent / "hyperparams"
    assert hyperparameter_file("sac", "PourWater-v0") == ours / "sac.yml"
    assert hyperparameter_file("sac", "Pendulum-v1") == zoo / "sac.yml"
    assert hyperparameter_file("sac_por", "MyPixels-v0") == ours / "sac_por.yml"
    assert hyperparameter_file("sac_drq", "FoldCloth-v0", demos=True) == ours / "demos.yml"
    assert hyperparameter_file("sac_por", "MyPixels-v0", demos=True) == ours / "sac_por.yml"
    assert hyperparameter_file("sac", "MyStates-v0") == zoo / "sac.yml"
    with pytest.raises(UserError, match="no settings of her for MyStates-v0"):
        hyperparameter_file("her", "MyStates-v0")


@pytest.mark.parametrize("file", sorted((ROOT / "zoo_hyperparams").rglob("*.yml")), ids=lambda file: file.stem)
def test_hyperparameter_files_hold_numbers_where_they_mean_numbers(file):
    for name, settings in yaml.safe_load(file.read_text()).items():
        assert settings["n_timesteps"] > 0, name
        for key, value in settings.items():
            # PyYAML reads 1e-3, without a point, as a string.
            assert not (isinstance(value, str) and value[:1].isdigit()), f"{name}: {key} is the string {value!r}"


@pytest.mark.parametrize("folder", [".", "paper"])
def test_rivals_differ_by_what_belongs_to_their_methods_alone(folder):
    files = (ROOT / "zoo_hyperparams" / folder / f"{algo}.yml" for algo in ALGORITHMS)
    own = {"por_coef", "aux_lr_ratio", "pairing", "n_augmentations", "n_target_augmentations"}
    first, *others = [
        {
            env: {key: value for key, value in settings.items() if key not in own}
            for env, settings in yaml.safe_load(text).items()
        }
        for text in (file.read_text() for file in files)
    ]
    assert len(others) == len(ALGORITHMS) - 1 and all(other == first for other in others)


@pytest.mark.parametrize("algo", sorted(ALGORITHMS))
def test_every_algorithm_has_settings(algo):
    assert hyperparameter_file(algo, "PourWater-v0") == ROOT / "zoo_hyperparams" / f"{algo}.yml"


def test_policies_are_checked_against_observations():
    image = gym.spaces.Box(0, 255, (40, 40, 3), np.uint8)
    vector = gym.spaces.Box(-1, 1, (3,), np.float32)
    many = gym.spaces.MultiDiscrete([2, 2])
    for policy, space in (("CnnPolicy", vector), ("CnnPolicy", many), ("MultiInputPolicy", image)):
        with pytest.raises(UserError, match=f"{policy} cannot read the observations of E-v0"):
            check_policy(policy, space, "E-v0")
    check_policy("CnnPolicy", image, "E-v0")
    check_policy("MlpPolicy", image, "E-v0")
    check_policy("MultiInputPolicy", gym.spaces.Dict({"image": image}), "E-v0")


def test_a_word_is_a_word_though_python_knows_it():
    parser = argparse.ArgumentParser()
    parser.add_argument("--settings", nargs="+", action=Settings)
    given = parser.parse_args(["--settings", "obs_type:dict", "pairing:paper", "gamma:0.9", "f:lambda x: x"]).settings
    assert given.pop("f")(3) == 3
    assert given == {"obs_type": "dict", "pairing": "paper", "gamma": 0.9}


def test_yamls_words_are_values_and_a_flag_given_again_adds():
    parser = argparse.ArgumentParser()
    parser.add_argument("--settings", nargs="+", action=Settings)
    words = ["--settings", "keep_hold:false", "a:True", "b:null", "--settings", "pairing:paper", "b:1"]
    assert parser.parse_args(words).settings == {"keep_hold": False, "a": True, "b": 1, "pairing": "paper"}
    parser.set_defaults(settings={"of": "before"})
    assert parser.parse_args(["--settings", "k:3"]).settings == {"k": 3}, "defaults are replaced"


def test_images_that_are_flattened_are_said(capsys):
    check_policy("MlpPolicy", gym.spaces.Box(0, 255, (40, 40, 3), np.uint8), "E-v0")
    assert "MlpPolicy flattens the images of E-v0 into 4800 numbers" in capsys.readouterr().err


@pytest.mark.parametrize("named", [["--env", "Mine-v0", "--gym-packages", "of_my_own"], ["--env", "of_my_own:Mine-v0"]])
def test_an_environment_of_ones_own_is_trained_on_and_its_model_used(named, tmp_path, monkeypatch, capsys):
    package = "import gymnasium as gym\nfrom gymnasium.envs.classic_control import PendulumEnv\n"
    package += "if 'Mine-v0' not in gym.registry:\n    gym.register('Mine-v0', PendulumEnv, max_episode_steps=20)\n"
    (tmp_path / "of_my_own.py").write_text(package)
    monkeypatch.syspath_prepend(tmp_path)
    flags = [*named, "-n", "60", "--eval-freq", "30", "-f", str(tmp_path / "logs")]
    settings = ["policy:MlpPolicy", "env_kwargs:{'g': 5.0}", "normalize:True"]
    hyperparams = tmp_path / "mine.yml"
    hyperparams.write_text("Mine-v0: {policy: MlpPolicy, n_timesteps: 60, env_kwargs: {render_mode: rgb_array}}\n")
    arguments = [*PENDULUM[:2], *PENDULUM[4:], "-conf", str(hyperparams), *flags, *SMALL, *settings]
    assert main(arguments) == 0
    run = tmp_path / "logs" / "sac" / "Mine-v0_1"
    assert yaml.safe_load((run / "Mine-v0" / "config.yml").read_text())["env_kwargs"] == {"g": 5.0, "render_mode": "rgb_array"}
    capsys.readouterr()
    gym.registry.pop("Mine-v0")
    sys.modules.pop("of_my_own")
    recorded = read_scores([run])["return"].max()
    # The folder above a single run stands for it
    for env_id, model in (("Mine-v0", run), ("of_my_own:Mine-v0", tmp_path / "logs")):
        assert evaluation_main(["evaluate", "--model", str(model), "--env", env_id, "-n", "2", "--json"]) == 0
        shown = json.loads(capsys.readouterr().out)
        # The best model with the statistics of its time
        assert shown["mean"]["return"] == pytest.approx(recorded)


def test_help_has_an_example_and_our_defaults():
    shown = subprocess.run([sys.executable, "train.py", "--help"], cwd=ROOT, capture_output=True, text=True)
    assert shown.returncode == 0 and "python train.py --algo sac_por --env PourWater-v0" in shown.stdout
    assert "evaluate every N agent steps (default 2000)" in " ".join(shown.stdout.split())


def test_por_trains_on_pouring_from_the_command_line(tmp_path):
    flags = ["-n", "60", "--eval-freq", "60", "--eval-episodes", "1", "--seed", "1", "--num-threads", "1", "-f", str(tmp_path)]
    small = ["-params", "learning_starts:40", "batch_size:8", "buffer_size:100", "pairing:paper"]
    command = [sys.executable, "train.py", "--algo", "sac_por", "--env", "PourWater-v0", *flags, *small]
    done = subprocess.run([*command, "--env-kwargs", "image_size:40"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "Step 60: normalized performance" in done.stdout
    run = tmp_path / "sac_por" / "PourWater-v0_1"
    model = load_model(run)
    assert type(model) is ALGORITHMS["sac_por"] and model.pairing == "paper"
    assert model.observation_space.shape == (3, 40, 40)
    assert len(read_scores([run])) == 1


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_settings_at_the_papers_scale_build_the_papers_encoder(algo):
    settings = yaml.safe_load((ROOT / "zoo_hyperparams" / "paper" / f"{algo}.yml").read_text())
    assert set(settings) == set(ENV_IDS) - {"FallingBall-v0", "SwingingBall-v0"}
    for env_id, scale in (("PourWater-v0", 20), ("PourWaterAmount-v0", 20), ("StraightenRope-v0", 50), ("FoldCloth-v0", 50)):
        assert settings[env_id]["reward_scale"] == scale and settings[env_id]["n_timesteps"] == 500_000
    arguments = settings["DropFoldCloth-v0"]
    env_kwargs, _ = arguments.pop("env_kwargs"), arguments.pop("n_timesteps")
    env = gym.make("FallingBall-v0", **env_kwargs)
    model = ALGORITHMS[algo](arguments.pop("policy"), env, **{**arguments, "buffer_size": 10})
    assert [conv.stride[0] for conv in model.critic.features_extractor.trunk if hasattr(conv, "stride")] == [2, 1, 1, 1]
    assert model.critic.projection.block_dims == [32 * 57 * 57]


def test_the_recipe_of_drq_v2_trains(tmp_path):
    file = ROOT / "zoo_hyperparams" / "paper" / "drq_v2.yml"
    small = ["buffer_size:50", "batch_size:4", "learning_starts:10", "policy_kwargs:{'net_arch':[8]}"]
    flags = ["--algo", "sac_drq", "--env", "PourWater-v0", "-conf", str(file), "--label", "drq_v2", "-n", "14", "--seed", "0"]
    assert main([*flags, "--eval-freq", "14", "--eval-episodes", "1", "-f", str(tmp_path), "-params", *small]) == 0
    model = load_model(tmp_path / "sac_drq" / "PourWater-v0_1" / "PourWater-v0.zip")
    assert model.observation_space.shape == (9, 84, 84) and model.n_steps == 3 and model._n_updates == 2


def test_tracking_without_its_package_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main([*PENDULUM, "--track"]) == 2
    assert capsys.readouterr().err.strip() == "train.py: error: --track needs Weights & Biases: pip install wandb"


def test_a_model_of_another_method_is_refused_in_one_line(tmp_path, capsys):
    ALGORITHMS["sac_por"]("MlpPolicy", "Pendulum-v1", buffer_size=10).save(tmp_path / "por.zip")
    flags = ["--algo", "sac_drq", "--env", "Pendulum-v1", "-n", "10", "-i", str(tmp_path / "por.zip"), "-f", str(tmp_path)]
    assert main([*flags, "-params", "policy:MlpPolicy"]) == 2
    shown = capsys.readouterr().err.splitlines()[-1]
    assert "SACDrQ has no objective" in shown and "PartialOrder" in shown and "load_encoder()" in shown
    flags[1] = "sac"  # can predict with it, and is refused before its random steps
    assert main([*flags, "-params", "policy:MlpPolicy"]) == 2
    assert "the objective PartialOrder can predict in a class of Stable-Baselines3, not learn" in capsys.readouterr().err
    assert not list(tmp_path.glob("*/Pendulum-v1_*"))


def test_normalized_images_are_refused_with_what_to_pass_instead(tmp_path, capsys):
    words = ["--algo", "sac_por", "--env", "FallingBall-v0", "-n", "1", "-f", str(tmp_path), "--env-kwargs", "image_size:36"]
    assert main([*words, "-params", "normalize:True"]) == 2
    assert "normalize:{'norm_obs':False,'norm_reward':True}" in capsys.readouterr().err

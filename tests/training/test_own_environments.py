"""Environments that are not ours: without variations, without a limit of their own, in a namespace."""

import sys
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import AddRenderObservation
from stable_baselines3 import SAC

from sb3_por import SACDrQ
from sb3_por.__main__ import main as evaluation_main
from sb3_por.common.errors import UserError, UserNote
from sb3_por.evaluation import evaluate, load_safe
from sb3_por.evaluation.episodes import evaluation_episodes, training_episodes
from sb3_por.evaluation.loading import resolve
from sb3_por.runs.facts import take_inventory
from sb3_por.runs.folder import is_finished
from sb3_por.sharing.export import export_run
from sb3_por.training.arguments import _check_kept
from sb3_por.training.zoo import main
from softbody_envs.wrappers import ActionRepeat

ENV_ID = "ours/Line-v0"
SMALL = ["learning_starts:10", "buffer_size:50", "batch_size:4", "policy_kwargs:{'net_arch':[8]}"]


class Line(gym.Env):
    """Never ends by itself; only a limit does. Observes a number that is drawn at the reset."""

    metadata: ClassVar[dict] = {"render_modes": ["rgb_array"], "render_fps": 10}
    observation_space, action_space = spaces.Box(-99, 99, (1,)), spaces.Box(-1, 1, (1,))

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.start = 0, self.np_random.uniform(5, 9, 1).astype(np.float32)
        return self.start, {}

    def step(self, action):
        self.steps += 1
        assert self.steps <= 10, "an episode without an end"
        return self.start, float(action[0]), False, False, {}

    def render(self):
        return np.full((40, 40, 3), 100, np.uint8)


@pytest.fixture
def line(monkeypatch):
    monkeypatch.setitem(sys.modules, "lines", sys.modules[__name__])
    gym.register(ENV_ID, f"{__name__}:Line")
    yield ["--algo", "sac", "--env", ENV_ID, "--env-kwargs", "max_episode_steps:10", "--eval-episodes", "1"]
    del gym.registry[ENV_ID]


@pytest.fixture
def run(line, tmp_path):
    flags = [*line, "-n", "40", "--eval-freq", "20", "--save-freq", "15", "--seed", "1", "-f", str(tmp_path / "logs")]
    assert main([*flags, "-params", *SMALL, "normalize:True"]) == 0
    return tmp_path / "logs" / "sac" / "ours-Line-v0_1"


def test_an_id_with_a_namespace_is_trained_evaluated_exported_and_finished(run, tmp_path, capsys):
    assert is_finished(run, ENV_ID) and [facts.state for facts in take_inventory([run])] == ["finished"]
    assert take_inventory([run])[0].settings["buffer_size"] == 50
    _, environment = resolve(run, ENV_ID)
    assert environment["vec_normalize"] == str(run / "ours-Line-v0" / "best_vecnormalize.pkl")
    with np.load(run / "evaluations.npz") as file:
        best = file["results"].mean(axis=1).max()
    assert np.mean(evaluate(run, ENV_ID, n_episodes=1).returns) == pytest.approx(best, abs=1e-5)
    assert export_run(run, tmp_path / "agents", n_episodes=1).model.name == "sac-ours-Line-v0.zip"
    with pytest.raises(SystemExit, match="0"):
        main(["--resume", str(run)])
    assert "is finished: nothing to do" in capsys.readouterr().out


def test_a_model_between_plays_with_statistics_of_the_end_and_says_so(run):
    with pytest.warns(UserNote, match="statistics of observations of the run's end"):
        resolve(run / "rl_model_15_steps.zip", ENV_ID)


def test_a_run_without_evaluations_names_its_last_model(run, capsys):
    (run / "best_model.zip").unlink()
    assert evaluation_main(["evaluate", "--model", str(run), "--env", ENV_ID]) == 2
    error = capsys.readouterr().err
    assert "there is no best_model.zip in" in error and f"the newest model is {run / 'ours-Line-v0.zip'}" in error


@pytest.mark.parametrize(
    "changes, message",
    [
        (["--seed", "7"], "continues a run of seed 1; leave out --seed"),
        (["-params", "policy_kwargs:{'net_arch':[16]}"], "a loaded model keeps its networks; leave out policy_kwargs"),
    ],
)
def test_a_resumed_run_stays_what_it_was(changes, message, run, capsys):
    assert main(["--resume", str(run), "-n", "60", *changes]) == 2
    assert message in capsys.readouterr().err
    assert main(["--resume", str(run), "-n", "50", "--seed", "1", "-params", SMALL[-1]]) == 0


def test_a_loaded_agent_keeps_its_networks(line, run, capsys):
    assert main([*line, "-i", str(run / "best_model.zip"), "-n", "60", "-params", "policy_kwargs:{'net_arch':[7]}"]) == 2
    assert "a loaded model keeps its networks" in capsys.readouterr().err


def test_a_resumed_run_keeps_its_kind_of_temperature_and_its_number_of_environments(run, capsys):
    assert main(["--resume", str(run), "-n", "60", "-params", "ent_coef:0.2"]) == 2
    assert "the temperature of a loaded model stays learned; leave out ent_coef" in capsys.readouterr().err
    _check_kept("ppo", {"ent_coef": 0.1}, {})
    _check_kept("td3", {"ent_coef": 0.1}, {})  # has none, which another check says
    with pytest.raises(UserError, match="stays fixed"):
        _check_kept("sac_por", {"ent_coef": "auto"}, {"ent_coef": 0.2})
    assert main(["--resume", str(run), "-n", "60", "--save-replay-buffer", "-params", SMALL[-1]]) == 0
    settings = (run / "ours-Line-v0" / "config.yml").read_text()
    assert main(["--resume", str(run), "-n", "80", "-params", "n_envs:2"]) == 2
    assert "the replay buffer is of 1 environments; pass -params n_envs:1" in capsys.readouterr().err
    assert (run / "ours-Line-v0" / "config.yml").read_text() == settings


def test_where_nothing_else_ends_an_episode_the_limit_of_training_does(line, tmp_path):
    model = SACDrQ("MlpPolicy", gym.make(ENV_ID, max_episode_steps=10), buffer_size=20, learning_starts=15).learn(12)
    assert evaluate(model, ENV_ID, n_episodes=2).lengths == [10, 10]
    model.save(tmp_path / "model.zip")
    safe = load_safe(tmp_path / "model.zip", device="cpu")
    assert evaluate(safe, ENV_ID, n_episodes=1).lengths == [10]


def test_pictures_in_place_of_vectors_can_be_evaluated(line):
    env = AddRenderObservation(gym.make(ENV_ID, max_episode_steps=10, render_mode="rgb_array"), render_only=True)
    model = SACDrQ("CnnPolicy", env, buffer_size=20, learning_starts=15).learn(12)
    assert evaluate(model, ENV_ID, n_episodes=1).lengths == [10]


def test_a_model_that_does_not_tell_its_wrappers_gets_a_note(tmp_path):
    env = ActionRepeat(gym.make("Pendulum-v1"), repeat=5)
    SAC("MlpPolicy", env, buffer_size=10, policy_kwargs=dict(net_arch=[8])).save(tmp_path / "model.zip")
    with pytest.warns(UserNote, match="does not tell how its environment was wrapped"):
        evaluate(SAC.load(tmp_path / "model.zip"), "Pendulum-v1", n_episodes=1)


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "PourWater-v0"])
def test_training_episodes_are_none_of_evaluation(env_id):
    starts = [
        {(one.seed, one.variation) for one in episodes}
        for episodes in (training_episodes(env_id, 50, 0), training_episodes(env_id, 50, 1), evaluation_episodes(env_id, 200))
    ]
    assert not (starts[0] | starts[1]) & starts[2]


def test_a_wrapper_that_misses_something_in_info_says_so_in_one_line(line, tmp_path, capsys):
    wrapper = "env_wrapper:[{'softbody_envs.wrappers.SuccessReward':{}}]"
    assert main([*line, "-n", "20", "-f", str(tmp_path), "-params", *SMALL, wrapper]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("train.py: error: SuccessReward needs info['is_success'], which")

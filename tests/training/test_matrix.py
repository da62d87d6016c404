"""What train.py accepts can be evaluated, recorded, diagnosed, reported and extended, by the same words."""

import json
import sys

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_por.__main__ import main as por
from sb3_por.runs.folder import read_evaluations
from sb3_por.training.zoo import main as train

PACKAGE = '''
import gymnasium as gym
import numpy as np
from toy_envs import DotEnv


class Dot(DotEnv):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode=None, **kwargs):
        super().__init__(size=36, falling=True, **kwargs)
        self.render_mode = render_mode

    def render(self):
        return np.full((16, 16, 3), self.t, np.uint8)


class Mirror(gym.ActionWrapper):
    """Takes a class and a tuple as arguments."""

    def __init__(self, env, kind, factors):
        super().__init__(env)
        assert isinstance(kind, type) and isinstance(factors, tuple), (kind, factors)
        self.factors = factors

    def action(self, action):
        return action * np.array(self.factors, np.float32)


if "Matrix-v0" not in gym.registry:
    gym.register("Matrix-v0", Dot)
'''
MIRROR = "env_wrapper:{'dots_of_my_own.Mirror': {'kind': gym.Env, 'factors': (-0.5,)}}"
EXTRACT = "vec_env_wrapper:{'stable_baselines3.common.vec_env.VecExtractDictObs': {'key': 'image'}}"
STACK = "frame_stack:2"
REWARD = "normalize:{'norm_obs': False}"
STATE = "normalize:{'norm_obs_keys': ['state']}"
POLICIES = {"pixels": "CnnPolicy", "state": "MlpPolicy", "dict": "MultiInputPolicy"}
#: Type of observations, settings, kind of vectorized environments: every pair of words occurs, if it can.
WORDS = [
    ("pixels", [STACK, MIRROR, REWARD], "dummy"),
    pytest.param("pixels", [MIRROR], "subproc", marks=pytest.mark.slow),
    ("state", [STACK, MIRROR, "normalize:True"], "dummy"),
    ("state", ["normalize:True", "n_envs:2"], "subproc"),
    ("dict", [STACK, MIRROR, STATE], "dummy"),
    pytest.param("dict", [STACK, REWARD, "n_envs:2"], "dummy", marks=pytest.mark.slow),
    pytest.param("dict", [STATE], "subproc", marks=pytest.mark.slow),
    ("dict", [EXTRACT, STACK, "policy:CnnPolicy"], "dummy"),
]


@pytest.mark.parametrize(("obs_type", "settings", "vec_env"), WORDS)
def test_what_trains_can_be_used(obs_type, settings, vec_env, tmp_path, monkeypatch, capsys):
    (tmp_path / "dots_of_my_own.py").write_text(PACKAGE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "dots_of_my_own", raising=False)
    gym.registry.pop("Matrix-v0", None)
    small = ["learning_starts:20", "buffer_size:200", "batch_size:8", f"policy:{POLICIES[obs_type]}", *settings]
    flags = ["--gym-packages", "dots_of_my_own", "--env-kwargs", f"obs_type:{obs_type}", "--vec-env", vec_env, "--seed", "1"]
    often = ["-n", "60", "--eval-freq", "30", "--eval-episodes", "2", "-f", str(tmp_path / "logs")]
    assert train(["--algo", "sac_por", "--env", "Matrix-v0", *often, *flags, "-params", *small]) == 0
    run = tmp_path / "logs" / "sac_por" / "Matrix-v0_1"
    best = read_evaluations(run)["results"].mean(axis=1).max()
    model = ["--model", str(run), "--env", "Matrix-v0"]
    capsys.readouterr()
    assert por(["evaluate", *model, "-n", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["mean"]["return"] == pytest.approx(best, rel=1e-4)
    assert por(["enjoy", *model, "-o", str(tmp_path / "video.gif")]) == 0
    assert por(["diagnose", *model, "-n", "1"]) == 0
    assert por(["report", str(run), "-o", str(tmp_path / "page")]) == 0
    shown = capsys.readouterr().err
    assert "not everything can be shown" not in (tmp_path / "page" / "index.html").read_text(), shown
    assert train(["--resume", str(run), "-n", "100"]) == 0
    data = load_from_zip_file(run / "Matrix-v0.zip", load_data=True)[0]
    assert data["num_timesteps"] == 100
    assert read_evaluations(run)["timesteps"].tolist() == [30, 60, 90, 100]
    assert np.isfinite(read_evaluations(run)["results"]).all()

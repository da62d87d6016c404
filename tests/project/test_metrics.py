"""Every logged metric is on docs/metrics.md, and nothing else is."""

import re
from pathlib import Path

import numpy as np
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_envs import DotEnv

from sb3_por import ALGORITHMS
from sb3_por.evaluation.episodes import Episode, FixedEpisodes
from sb3_por.training.callbacks import EvaluationCallback, Stopwatch

PAGE = Path(__file__).parents[2] / "docs" / "metrics.md"
POLICY = dict(net_arch=[8], features_extractor_kwargs=dict(features_dim=8, n_filters=4, strides=(2, 2)))


class ScoredDotEnv(DotEnv):
    """Reports what the tasks report."""

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return (
            observation,
            reward,
            terminated,
            truncated,
            info | {"normalized_performance": reward, "is_success": reward > 0.5},
        )


class Names(KVWriter):
    """Collects the names of what is logged."""

    def __init__(self):
        self.names = set()

    def write(self, key_values, key_excluded, step=0):
        self.names |= {name for name, value in key_values.items() if np.isfinite(value)}

    def close(self):
        pass


def logged_names(cls, folder):
    writer = Names()
    arguments = dict(
        policy_kwargs=POLICY, buffer_size=100, learning_starts=20, batch_size=8, diagnostics_interval=5, bc_coef=1.0
    )
    model = cls("CnnPolicy", ScoredDotEnv(size=20), device="cpu", **arguments)
    model.demo_buffer = model.replay_buffer  # what the agent has played, in the place of demonstrations
    model.set_logger(Logger(folder=None, output_formats=[writer]))
    env = DummyVecEnv([lambda: FixedEpisodes(Monitor(ScoredDotEnv(size=20)))])
    callback = EvaluationCallback(env, [Episode(0, 0, None)], 40, folder, Stopwatch(), verbose=0)
    model.learn(90, callback=callback, log_interval=1)
    return writer.names


def test_the_page_lists_what_is_logged(tmp_path):
    listed = set(re.findall(r"`((?:train|eval|rollout|time)/\w+)`", PAGE.read_text()))
    logged = set().union(*(logged_names(cls, tmp_path / name) for name, cls in ALGORITHMS.items()))
    assert listed == logged

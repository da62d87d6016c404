"""Half of each batch comes from the demonstrations, in every algorithm, and nothing changes without them."""

import copy
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from toy_envs import DotEnv

from sb3_por import SACCURL, SACPOR, SACSPR, TQCPOR, SACDrQ, VisualSAC
from sb3_por.common.errors import UserError, UserNote
from sb3_por.demonstrations.dataset import RecordedEpisode, write_demonstrations
from sb3_por.training.zoo import main
from softbody_envs.wrappers import ActionRepeat

pytest.importorskip("minari", reason="pip install 'sb3-por[demos]'")
POLICY = dict(net_arch=[16], features_extractor_kwargs=dict(features_dim=8, n_filters=4, strides=(2, 2)))
#: Added to the rewards of demonstrations, so that they can be told from the agent's
MARK = 1000.0


def play(env, n_episodes, mark=MARK, action=None):
    """Episodes with random actions; the reward is marked."""
    env.action_space.seed(3)
    for seed in range(n_episodes):
        observations, actions, rewards, done = [env.reset(seed=seed)[0]], [], [], False
        while not done:
            actions.append(env.action_space.sample() if action is None else action)
            observation, reward, terminated, truncated, _ = env.step(actions[-1])
            observations.append(observation)
            rewards.append(float(reward) + mark)
            done = terminated or truncated
        is_dict = isinstance(observation, dict)
        parts = (
            {key: np.stack([one[key] for one in observations]) for key in observation} if is_dict else np.stack(observations)
        )
        yield RecordedEpisode(parts, np.stack(actions), np.array(rewards), terminated, seed)


def write(path, env, n_episodes=3, **kwargs):
    write_demonstrations(path, play(env, n_episodes, **kwargs), env.observation_space, env.action_space)
    return str(path)


def dots(**kwargs):
    return DotEnv(size=16, horizon=9, falling=True, **kwargs)


def make_model(cls, env, policy="CnnPolicy", **kwargs):
    policy_kwargs = {} if policy == "MlpPolicy" else POLICY
    settings = dict(buffer_size=200, learning_starts=10, batch_size=8, seed=1, device="cpu", policy_kwargs=policy_kwargs)
    return cls(policy, env, **(settings | kwargs))


def marked(batch):
    return (batch.rewards[:, 0] > MARK / 2).tolist()


@pytest.mark.parametrize("cls", [SACPOR, SACCURL, SACSPR, SACDrQ, TQCPOR])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_every_second_row_is_a_demonstration_and_training_runs(cls, n_steps, tmp_path):
    model = make_model(cls, dots(), n_steps=n_steps, demos=write(tmp_path / "demos", dots()), bc_coef=1.0)
    model.learn(20)
    batch = model.sample(9)
    assert marked(batch) == [False, True] * 4 + [False]
    assert model.demo_buffer.size() == 27 and type(model.demo_buffer) is type(model.replay_buffer)
    assert all(value is None or isinstance(value, dict) or len(value) == 9 for value in batch)
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())


def test_sampled_demonstrations_are_the_recorded_steps_with_their_episodes_neighbours(tmp_path):
    env, recorded = dots(), list(play(dots(), 3, mark=0.0))
    for e, episode in enumerate(recorded):  # a pixel of each frame tells its episode and its time
        episode.observations[:, -1, -1] = [(e, t, 0) for t in range(10)]
    write_demonstrations(tmp_path / "demos", recorded, env.observation_space, env.action_space)
    model = make_model(SACPOR, env, n_steps=3, k=2, gamma=0.9)
    model.load_demos(tmp_path / "demos")
    batch = model._sample(64, model.demo_buffer)

    def place(frame):
        return tuple(frame[:2, -1, -1].tolist())

    for row in range(64):
        e, t = place(batch.observations[row])
        n = min(3, 9 - t)
        assert place(batch.next_observations[row]) == (e, t + n)
        assert place(batch.future_observations[row]) == (e, min(t + 2, 9))
        assert place(batch.past_observations[row]) == (e, max(t - 2, 0))
        assert batch.actions[row].item() == pytest.approx(recorded[e].actions[t].item(), abs=1e-6)
        expected = sum(0.9**i * recorded[e].rewards[t + i] for i in range(n))
        assert batch.rewards[row].item() == pytest.approx(expected, rel=1e-5)
        assert batch.dones[row] == 0.0 and batch.discounts[row].item() == pytest.approx(0.9**n)


def test_a_terminated_demonstration_has_no_future_value(tmp_path):
    episodes = [
        RecordedEpisode(np.zeros((5, 3), np.float32), np.zeros((4, 1), np.float32), np.zeros(4), terminated)
        for terminated in (True, False)
    ]
    env = gym.make("Pendulum-v1")
    write_demonstrations(tmp_path / "demos", episodes, env.observation_space, env.action_space)
    model = make_model(VisualSAC, env, "MlpPolicy")
    model.load_demos(tmp_path / "demos")
    buffer = model.demo_buffer
    assert buffer.dones[:, 0].tolist() == [0, 0, 0, 1, 0, 0, 0, 1] and buffer.timeouts[:, 0].tolist() == [0] * 7 + [1]


def test_actions_are_scaled_as_the_agents_own(tmp_path):
    env = gym.make("Pendulum-v1")
    model = make_model(VisualSAC, env, "MlpPolicy")
    model.load_demos(write(tmp_path / "demos", gym.make("Pendulum-v1"), 1, action=np.array([1.0], np.float32)))
    assert (model.demo_buffer.actions == 0.5).all()


@pytest.mark.parametrize("obs_type, policy", [("dict", "MultiInputPolicy"), ("state", "MlpPolicy")])
def test_dict_and_state_observations(obs_type, policy, tmp_path):
    demos = write(tmp_path / "demos", DotEnv(size=32, horizon=9, obs_type=obs_type))
    env = DotEnv(size=32, horizon=9, obs_type=obs_type)
    model = make_model(SACPOR, env, policy, policy_kwargs={}, demos=demos).learn(14)
    assert marked(model.sample(8)) == [False, True] * 4


def test_frames_are_stacked_and_normalized_as_the_agents_own(tmp_path):
    demos = write(tmp_path / "demos", dots(obs_type="state"))
    env = VecNormalize(VecFrameStack(DummyVecEnv([lambda: dots(obs_type="state")] * 2), 3))
    model = make_model(VisualSAC, env, "MlpPolicy", demos=demos).learn(20)
    first, second = model.demo_buffer.observations[:2, 0]
    assert (first[:4] == 0).all() and (first[4:] != 0).any()
    assert (second[2:4] == first[4:]).all() and (second[4:] != first[4:]).any()
    batch = model.sample(8)
    # Marked rewards divided by the deviation of the agent's returns, and clipped
    assert (batch.rewards[1::2] == env.clip_reward).all() and (batch.rewards[::2] < env.clip_reward).all()


def test_images_keep_their_layout_in_memory(tmp_path):
    model = make_model(SACSPR, dots(), demos=write(tmp_path / "demos", dots())).learn(12)
    batch, alone = model.sample(8), model.sample(8, model.replay_buffer)
    assert batch.observations.stride() == alone.observations.stride()
    assert batch.window_observations.stride() == alone.window_observations.stride()


def test_cloning_pulls_the_actions_to_those_of_the_demonstrations(tmp_path):
    demos = write(tmp_path / "demos", dots(), mark=0.0, action=np.array([0.7], np.float32))
    frames = np.stack([episode.observations[0] for episode in play(dots(), 3)])
    distances = []
    for bc_coef in (100.0, 0.0):
        model = make_model(VisualSAC, dots(), demos=demos, bc_coef=bc_coef, learning_rate=3e-3).learn(10)
        model._current_progress_remaining = 1.0
        model.train(150, 16)
        distances.append(np.abs(model.predict(frames, deterministic=True)[0] - 0.7).mean())
    assert distances[0] < 0.1 < distances[1]


@pytest.mark.parametrize("share, bc_coef, reached", [(True, 1.0, True), (False, 1.0, False), (True, 0.0, False)])
def test_cloning_trains_the_encoder_that_actor_and_critic_share(share, bc_coef, reached, tmp_path):
    """An actor with a trunk of its own trains that."""
    demos, kwargs = write(tmp_path / "demos", dots()), dict(POLICY, share_features_extractor=share)
    model = make_model(VisualSAC, dots(), demos=demos, bc_coef=bc_coef, policy_kwargs=kwargs).learn(12)
    model._current_progress_remaining = 0.5
    cloning = model.losses(model.sample(8)).cloning
    assert (cloning > 0) == reached
    if reached:
        trunk = list(model.critic.features_extractor.parameters())
        assert all((gradient != 0).any() for gradient in th.autograd.grad(cloning, trunk))
    before = copy.deepcopy(list(model.critic.features_extractor.parameters()))
    model.critic.optimizer = th.optim.SGD(model.critic.parameters(), lr=1.0)
    losses = model.losses(model.sample(8))
    model._step_encoder(losses._replace(critic=0.0 * losses.critic))
    after = model.critic.features_extractor.parameters()
    assert any(not th.equal(a, b) for a, b in zip(before, after, strict=True)) == reached


def test_cloning_fades_to_nothing_at_the_end_of_training(tmp_path):
    demos = write(tmp_path / "demos", dots())
    for progress_remaining, same in ((0.5, False), (0.0, True)):
        actors = []
        for bc_coef in (1.0, 0.0):
            model = make_model(VisualSAC, dots(), demos=demos, bc_coef=bc_coef).learn(10)
            model._current_progress_remaining = progress_remaining
            model.train(3, 8)
            actors.append(list(model.actor.parameters()))
        assert all(th.equal(a, b) for a, b in zip(*actors, strict=True)) == same


def test_loading_draws_no_random_numbers(tmp_path):
    demos = write(tmp_path / "demos", dots())
    model = make_model(SACPOR, dots())
    before = np.random.get_state()[1].copy(), th.get_rng_state()
    model.load_demos(demos)
    assert (np.random.get_state()[1] == before[0]).all() and th.equal(th.get_rng_state(), before[1])


def test_a_loaded_model_reads_its_demonstrations_when_it_learns(tmp_path):
    demos = write(tmp_path / "demos", dots())
    make_model(SACPOR, dots(), demos=demos).learn(12).save(tmp_path / "model.zip")
    loaded = SACPOR.load(tmp_path / "model.zip", env=dots())
    assert loaded.demo_buffer is None
    Path(demos).rename(tmp_path / "moved")
    with pytest.raises(UserError, match="there are no demonstrations in"):
        loaded.learn(12)
    moved = SACPOR.load(tmp_path / "model.zip", env=dots(), demos=str(tmp_path / "moved")).learn(12)
    assert marked(moved.sample(8)) == [False, True] * 4


def test_a_loaded_model_continues_bit_for_bit(tmp_path):
    settings = dict(demos=write(tmp_path / "demos", dots()), bc_coef=0.5, n_steps=3)
    first = make_model(SACPOR, dots(), **settings).learn(25)
    first.save(tmp_path / "model.zip")
    first.save_replay_buffer(tmp_path / "buffer.pkl")
    env = copy.deepcopy(first.get_env().unwrapped.envs[0])
    loaded = SACPOR.load(tmp_path / "model.zip", env=env, force_reset=False)
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    in_one_go = make_model(SACPOR, dots(), **settings).learn(25).learn(25, reset_num_timesteps=False)
    loaded.learn(25, reset_num_timesteps=False)
    assert in_one_go.num_timesteps == loaded.num_timesteps == 50
    for one, other in zip(in_one_go.policy.parameters(), loaded.policy.parameters(), strict=True):
        assert th.equal(one, other)


def test_what_does_not_fit_is_one_clear_error(tmp_path):
    model = make_model(VisualSAC, dots())
    for kwargs, message in (
        ({"size": 20}, "Observation spaces do not match"),
        ({"obs_type": "state"}, "not from the training"),
    ):
        path = write(tmp_path / str(kwargs), DotEnv(**({"size": 16} | kwargs)))
        with pytest.raises(UserError, match=message):
            model.load_demos(path)
    env, other = dots(), gym.spaces.Box(-1, 1, (2,), np.float32)
    episode = RecordedEpisode(next(play(env, 1)).observations, np.zeros((9, 2), np.float32), np.zeros(9), False)
    write_demonstrations(tmp_path / "actions", [episode], env.observation_space, other)
    with pytest.raises(UserError, match="Action spaces do not match"):
        model.load_demos(tmp_path / "actions")
    assert model.demo_buffer is None and model.demos is None
    with pytest.raises(UserError, match="batch_size must be at least 2"):
        make_model(VisualSAC, dots(), batch_size=1).load_demos(tmp_path)
    goals = gym.spaces.Dict({name: other for name in ("observation", "achieved_goal", "desired_goal")})
    with pytest.raises(UserError, match="HerReplayBuffer and demos exclude each other"):
        goal_env = gym.Env()
        goal_env.observation_space, goal_env.action_space = goals, other
        make_model(VisualSAC, goal_env, "MultiInputPolicy", policy_kwargs={}, replay_buffer_class=HerReplayBuffer).load_demos(
            tmp_path
        )


def test_demonstrations_of_another_environment_are_noted(tmp_path, recwarn):
    def made(repeat, **kwargs):
        return ActionRepeat(gym.make("Pendulum-v1", **kwargs), repeat)

    env = made(5, max_episode_steps=20)
    write_demonstrations(tmp_path / "demos", play(env, 1), env.observation_space, env.action_space, env.spec)
    for same in (made(5), Monitor(made(5))):
        make_model(VisualSAC, same, "MlpPolicy").load_demos(tmp_path / "demos")
    assert not [warning for warning in recwarn if issubclass(warning.category, UserNote)]
    for other in (made(4), made(5, g=9.0), gym.make("Pendulum-v1")):
        with pytest.warns(UserNote, match="actions and rewards may mean something else"):
            make_model(VisualSAC, other, "MlpPolicy").load_demos(tmp_path / "demos")


FLAGS = ["--algo", "sac_drq", "--env", "Pendulum-v1", "-n", "60", "--seed", "1", "--eval-freq", "-1", "--save-freq", "25"]
SMALL = ["-params", "policy:MlpPolicy", "policy_kwargs:{}", "buffer_size:500", "batch_size:16", "learning_starts:20"]


def test_train_learns_from_demonstrations_and_resumes_with_them(tmp_path, monkeypatch, capsys):
    demos, run = tmp_path / "demos", tmp_path / "sac_drq" / "Pendulum-v1_1"
    write(demos, gym.make("Pendulum-v1"), 1)
    sampled = []

    def die(callback):
        if callback.num_timesteps == 40:
            sampled.append(marked(callback.model.sample(4)))
            raise RuntimeError("killed")
        return True

    with monkeypatch.context() as patch:
        patch.setattr("sb3_por.training.experiment.CheckpointCallback._on_step", die)
        with pytest.raises(RuntimeError, match="killed"):
            main([*FLAGS, "--demos", str(demos), "-f", str(tmp_path), *SMALL])
        demos.rename(tmp_path / "moved")
        assert main(["--resume", str(run)]) == 2
        assert f"there are no demonstrations in {demos}" in capsys.readouterr().err
        with pytest.raises(RuntimeError, match="killed"):
            main(["--resume", str(run), "--demos", str(tmp_path / "moved")])
    assert sampled == [[False, True] * 2] * 2
    assert main(["--resume", str(run)]) == 0, "where they are now is on record"
    assert (run / "Pendulum-v1.zip").exists()


def test_train_refuses_what_cannot_work_and_leaves_no_folder(tmp_path, capsys):
    for flags, message in (
        (["--algo", "sac"], "sac cannot learn from demonstrations; --demos needs one of sac_por"),
        ([], "there are no demonstrations in nowhere"),
    ):
        assert main([*FLAGS, *flags, "--demos", "nowhere", "-f", str(tmp_path / "logs"), *SMALL]) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
        assert not list((tmp_path / "logs").glob("*/*"))


def test_cloning_without_demonstrations_is_noted():
    with pytest.warns(UserNote, match="bc_coef has no effect without demonstrations"):
        make_model(VisualSAC, dots(), bc_coef=1.0).learn(1)

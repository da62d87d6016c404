"""
What a GPU needs, on a simulated device: nothing mixes tensors of host and device, the results are those of the CPU bit for
bit, and no update makes the host wait.
"""

import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from simulated_device import NAME, memory, start, waits
from toy_envs import DotEnv

import sb3_por
from sb3_por.analysis.diagnostics import diagnose
from sb3_por.analysis.saliency import saliency_map

SIZES = dict(net_arch=[16], features_extractor_kwargs=dict(features_dim=8, n_filters=4, strides=(2, 2)))
DICT_SIZES = dict(net_arch=[16], features_extractor_kwargs=dict(cnn_output_dim=8, n_filters=4, strides=(2, 2)))
SOFTMAX = dict(net_arch=[16], features_extractor_kwargs=dict(n_filters=4, strides=(2, 2), center=True, spatial_softmax=True))


@pytest.fixture(scope="module")
def on_device():
    """Runs a function in a process that has the simulated device."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, initializer=start) as process:
        yield lambda function, *args, **kwargs: process.submit(function, *args, **kwargs).result()


def train(device, cls="SACPOR", policy="CnnPolicy", obs_type="pixels", **options):
    """A model after two episodes; the second one is learned from. If it clones, then what it has played itself."""
    arguments = dict(policy_kwargs=SIZES, buffer_size=50, learning_starts=20, batch_size=8, diagnostics_interval=3, seed=0)
    env = DotEnv(size=20, falling=True, obs_type=obs_type)
    model = getattr(sb3_por, cls)(policy, env, device=device, **{**arguments, **options})
    model.demo_buffer = model.replay_buffer if model.bc_coef > 0 else None
    return model.learn(40)


def numbers(model):
    """Everything that a model has learned, as one array."""
    optimizers = [model.actor.optimizer, model.critic.optimizer, model.policy.objective_optimizer]
    moments = [moment for one in optimizers if one for state in one.state.values() for moment in state.values()]
    return np.concatenate(
        [tensor.detach().cpu().numpy().ravel() for tensor in [*model.policy.state_dict().values(), *moments]]
    )


def train_on_both(**options):
    """What was learned on CPU and device, and what the host waited for in three more updates."""
    on_cpu, model = numbers(train("cpu", **options)), train(NAME, **options)
    assert next(model.policy.parameters()).device.type == NAME
    on_it = numbers(model)
    waits.clear()
    model.train(3, 8)
    return on_cpu, on_it, dict(waits)


@pytest.mark.parametrize(
    "options",
    [
        dict(cls="VisualSAC"),
        dict(),
        dict(pairing="paper"),
        dict(pairing="paper", k=3, random_k=True, order_head="difference"),
        dict(k=3, order_head="coordinatewise"),
        dict(cls="SACDrQ"),
        dict(cls="SACCURL"),
        dict(cls="SACSPR"),
        dict(cls="SACMRQ"),
        dict(cls="SACSPR", n_steps=3, bc_coef=1.0),
        dict(cls="TQCPOR"),
        dict(n_steps=3, start_at_mean_reward=True, reward_scale=20.0),
        dict(use_sde=True),
        dict(ent_coef=0.1),
        dict(policy_kwargs=SOFTMAX | dict(critic_layer_norm=True)),
        dict(policy_kwargs=SIZES | dict(share_features_extractor=False)),
        dict(replay_buffer_kwargs=dict(storage="cpu")),
        dict(policy="MultiInputPolicy", obs_type="dict", policy_kwargs=DICT_SIZES),
        dict(cls="VisualSAC", policy="MlpPolicy", obs_type="state", policy_kwargs=dict(net_arch=[16])),
        dict(overlap=True, train_freq=2, gradient_steps=2),
    ],
    ids=str,
)
def test_an_update_on_a_device_does_what_it_does_on_the_cpu_and_nobody_waits(on_device, options):
    on_cpu, on_it, waited_for = on_device(train_on_both, **options)
    assert np.array_equal(on_cpu, on_it)
    assert waited_for == {}


def places_of_frames(free):
    memory.free = free
    try:
        frames = train(NAME, learning_starts=100).replay_buffer._frames[""]
    finally:
        memory.free = 2**30
    return frames.ring.device.type, frames.loose.device.type


@pytest.mark.parametrize("free, place", [(2**30, NAME), (2**16, "cpu")])
def test_frames_are_kept_on_the_device_where_they_take_no_more_than_a_part_of_its_memory(on_device, free, place):
    assert on_device(places_of_frames, free) == (place, place)


def sample(buffer):
    np.random.seed(0)
    return buffer.sample(30).observations.cpu().numpy()


def buffer_of(device):
    buffer = train(device).replay_buffer
    samples = sample(buffer)
    # As SB3 does with a buffer that it loads; a GPU's name is known everywhere, this one's only here
    buffer.device = th.device("cpu")
    return pickle.dumps(buffer), samples, sample(buffer)


def test_a_buffer_from_a_device_can_be_read_without_one(on_device):
    pickled, samples, samples_to_host = on_device(buffer_of, NAME)
    assert np.array_equal(sample(pickle.loads(pickled)), samples) and samples.any()
    assert np.array_equal(samples_to_host, samples)


def diagnose_on(device):
    env = gym.make("FallingBall-v0", image_size=36)
    model = sb3_por.SACPOR("CnnPolicy", env, buffer_size=200, learning_starts=100, batch_size=16, seed=0, device=device)
    diagnosis = diagnose(model.learn(60), "FallingBall-v0", n_episodes=1)
    frames = np.random.default_rng(0).integers(0, 256, (2, 3, 36, 36), np.uint8)
    return diagnosis.as_dict(), saliency_map(model, *frames)


def test_diagnosis_and_saliency_are_those_of_the_cpu(on_device):
    diagnosis, saliency = on_device(diagnose_on, "cpu")
    same_diagnosis, same_saliency = on_device(diagnose_on, NAME)
    assert diagnosis == same_diagnosis
    assert np.array_equal(saliency, same_saliency) and saliency.max() == 1


def mix():
    th.zeros(2, device=NAME) + th.zeros(2)


def count(function):
    waits.clear()
    function(th.arange(3.0, device=NAME))
    return dict(waits)


def bring_without_waiting():
    th.zeros(2, device=NAME).to("cpu", non_blocking=True)


def read_a_number(tensor):
    return tensor.sum().item()


def take_positive(tensor):
    return tensor[tensor > 0]


def bring_a_number(tensor):
    return tensor.to("cpu"), th.ones(2).to(NAME), th.ones(2).to(NAME, non_blocking=True)


def test_the_device_sees_what_is_mixed_and_what_waits(on_device):
    with pytest.raises(RuntimeError, match="of the device and of the host"):
        on_device(mix)
    with pytest.raises(RuntimeError, match="without waiting"):
        on_device(bring_without_waiting)
    assert on_device(count, read_a_number) == {"_local_scalar_dense": 1}
    assert on_device(count, take_positive) == {"index": 1}
    assert on_device(count, bring_a_number) == {"_to_copy": 2}
    assert on_device(count, th.Tensor.exp_) == {}

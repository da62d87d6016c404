"""Saliency maps of POR's classifier (the paper's Figure 7), computed by captum."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch as th
from captum.attr import NoiseTunnel, Saliency
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecFrameStack, unwrap_vec_wrapper

from sb3_por.analysis.diagnostics import check_order
from sb3_por.common.errors import UserError
from sb3_por.common.files import atomic_write, check_output
from sb3_por.evaluation.environment import make_evaluation_env
from sb3_por.evaluation.episodes import evaluation_episodes
from sb3_por.evaluation.loading import resolve
from sb3_por.runs.environment import EnvWrapper, VecEnvWrapper

FORMATS = (".png", ".jpg")
#: SmoothGrad: number of noisy copies that gradients are averaged over, and standard deviation of the noise (grey levels).
N_SAMPLES, NOISE = 25, 8.0
#: Height and width of each picture, pixels.
SIZE = 480


def saliency_map(model: Any, earlier: np.ndarray, later: np.ndarray) -> np.ndarray:
    """
    Compute the influence of each pixel of the later frame on the classifier's belief that this frame is the later one:
    the absolute gradient of the logits (SmoothGrad, https://arxiv.org/abs/1706.03825), maximum over the colours.

    :param model: trained with a ``PartialOrder`` objective on images
    :param earlier: uint8, ``(channels, height, width)``
    :param later: uint8, same shape
    :return: float32 ``(height, width)``, from 0 to 1
    """
    objective = check_order(model)
    first = th.as_tensor(earlier[None], dtype=th.float32, device=model.device)
    x_first = objective.g(model.critic.encode(first)).detach()

    def belief(frames: th.Tensor) -> th.Tensor:
        x = objective.g(model.critic.encode(frames))
        before = x_first.expand(len(x), -1)
        return objective.c(x, before) - objective.c(before, x)

    model.policy.set_training_mode(False)
    th.manual_seed(0)
    inputs = th.as_tensor(later[None], dtype=th.float32, device=model.device).requires_grad_()
    gradient = NoiseTunnel(Saliency(belief)).attribute(inputs, nt_samples=N_SAMPLES, stdevs=NOISE)
    heat = gradient[0].amax(dim=0).detach().cpu().numpy()
    return heat / max(float(heat.max()), 1e-12)


def overlay(frame: np.ndarray, heat: np.ndarray, size: int = SIZE) -> np.ndarray:
    """
    Draw a saliency map over its frame.

    :param frame: uint8, RGB ``(height, width, 3)`` or grey ``(height, width, 1)``
    :param heat: saliency map, ``(height, width)`` in [0, 1]
    :param size: height and width of each picture
    :return: the frame, and beside it the frame in grey under the map; uint8 ``(size, 2 * size, 3)``
    """
    frame = cv2.resize(np.repeat(frame, 3 // frame.shape[2], axis=2), (size, size), interpolation=cv2.INTER_NEAREST)
    heat = cv2.resize(heat.astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC).clip(0, 1)
    colors = cv2.cvtColor(cv2.applyColorMap((255 * heat).astype(np.uint8), cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    grey = cv2.cvtColor(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    return np.hstack([frame, cv2.addWeighted(grey, 0.4, colors, 0.6, 0)])


def draw_saliency(
    model: Any,
    env_id: str,
    path: str | Path,
    step: int | None = None,
    seed: int = 0,
    env_kwargs: dict[str, Any] | None = None,
    vec_normalize: str | None = None,
    env_wrapper: EnvWrapper | None = None,
    vec_env_wrapper: VecEnvWrapper | None = None,
) -> int:
    """
    Play the first held-out episode, and draw the saliency map of one of its frames.

    :param model: a run folder, the path of a model, or a model; trained with a ``PartialOrder`` objective on images
    :param env_id: a Gymnasium id
    :param path: ``.png`` or ``.jpg``
    :param step: number of the later frame; by default the one with the largest rise of ``info["monotone"]``
    :param seed: seed of the episode
    :param env_kwargs: as in :func:`sb3_por.evaluation.evaluate`
    :param vec_normalize: as in :func:`sb3_por.evaluation.evaluate`
    :param env_wrapper: as in :func:`sb3_por.evaluation.evaluate`
    :param vec_env_wrapper: as in :func:`sb3_por.evaluation.evaluate`
    :return: number of the drawn frame
    :raises UserError: if the model learns no order from images, or there is no such step
    """
    model, environment = resolve(model, env_id, env_kwargs, vec_normalize, env_wrapper, vec_env_wrapper)
    _, k = check_order(model).future or (1, 1)
    path = check_output(path, FORMATS)
    if not isinstance(model.observation_space, spaces.Box) or len(model.observation_space.shape) != 3:
        raise UserError(f"a saliency map needs a model that observes images alone, not {model.observation_space}")
    env = make_evaluation_env(model, env_id, **environment)
    stack = unwrap_vec_wrapper(env, VecFrameStack)
    n_channels = model.observation_space.shape[0] // (1 if stack is None else stack.stacked_obs.n_stack)
    if n_channels not in (1, 3):
        env.close()
        raise UserError(f"a saliency map needs images in colour or grey, not of {n_channels} channels")
    try:
        env.env_method("play", evaluation_episodes(env_id, 1, seed))
        observation: Any = env.reset()
        done = False
        frames, monotone = [observation[0]], [env.unwrapped.reset_infos[0].get("monotone", 0.0)]
        while not done:
            observation, _, dones, infos = env.step(model.predict(observation, deterministic=True)[0])
            done = bool(dones[0])
            frames.append(infos[0]["terminal_observation"] if done else observation[0])
            monotone.append(infos[0].get("monotone", 0.0))
    finally:
        env.close()
    if step is None:
        step = k + int(np.argmax(np.array(monotone[k:]) - np.array(monotone[:-k])))
    if not k <= step < len(frames):
        raise UserError(f"--step must be from {k} to {len(frames) - 1}, got {step}")
    frame = np.ascontiguousarray(frames[step][-n_channels:].transpose(1, 2, 0))
    picture = overlay(frame, saliency_map(model, frames[step - k], frames[step]))
    with atomic_write(path) as temporary:
        # OpenCV's own writing does not tell of a full disk.
        temporary.write_bytes(cv2.imencode(path.suffix, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())
    return step

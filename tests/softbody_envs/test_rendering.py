"""A frame is the same whether pybullet was built with numpy or without."""

import gymnasium as gym
import numpy as np

import softbody_envs  # noqa: F401


def flat_tuples(image):
    """What a build without numpy returns for what a build with it does."""
    return *image[:2], *(tuple(np.asarray(array).ravel().tolist()) for array in image[2:])


def test_a_build_without_numpy_gives_the_same_frame(monkeypatch):
    env = gym.make("FoldCloth-v0", obs_type="pixels", image_size=32)
    env.reset(seed=0)
    task = env.unwrapped
    frame, depth = task.renderer.render(task.world, task.camera, 32)
    draw = task.world.client.getCameraImage
    monkeypatch.setattr(
        task.world.client, "getCameraImage", lambda *args, **kwargs: flat_tuples(draw(*args, **kwargs)), raising=False
    )
    again, depth_again = task.renderer.render(task.world, task.camera, 32)
    assert again.dtype == frame.dtype and depth_again.dtype == depth.dtype
    assert np.array_equal(again, frame) and np.array_equal(depth_again, depth)
    env.close()

"""What the encoders do to images."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn
from toy_envs import DotEnv

from sb3_por import ALGORITHMS
from sb3_por.visual.encoders import CenteredConv2d, CombinedEncoder, ConvEncoder, SpatialSoftmax

SPACE = spaces.Box(0, 255, (3, 32, 32), np.uint8)


def test_centered_convolution_is_a_convolution_of_the_images_minus_one_half():
    centered = CenteredConv2d(3, 4, kernel_size=3, stride=2)
    plain = nn.Conv2d(3, 4, kernel_size=3, stride=2)
    plain.load_state_dict(centered.state_dict())
    images = th.rand(5, 3, 9, 9)
    loss, expected = centered(images).square().mean(), plain(images - 0.5).square().mean()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5)
    for layer, value in ((centered, loss), (plain, expected)):
        value.backward()
        assert layer.weight.grad.abs().sum() > 0
    for one, other in zip(centered.parameters(), plain.parameters(), strict=True):
        th.testing.assert_close(one.grad, other.grad)


@pytest.mark.parametrize(("center", "normalized_image"), [(True, False), (False, False), (True, True)])
def test_center_subtracts_one_half_once_and_only_from_images_in_0_1(center, normalized_image):
    space = spaces.Box(-1.0, 1.0, SPACE.shape, np.float32) if normalized_image else SPACE
    gray = th.full((1, *space.shape), 0.5)
    encoder = ConvEncoder(space, center=center, normalized_image=normalized_image)
    combined = CombinedEncoder(spaces.Dict(image=space), center=center, normalized_image=normalized_image)
    centered = center and not normalized_image
    # At first the biases are 0
    assert encoder(gray).any().item() is not centered
    assert combined({"image": gray}).any().item() is not centered


def test_spatial_softmax_tells_mean_and_covariance_of_where_a_map_is_large():
    softmax = SpatialSoftmax(2, 3, 5, temperature=0.01)
    maps = th.zeros(1, 2, 3, 5)
    maps[0, 0, 0, 3] = 1.0  # one peak: above, to the right
    maps[0, 1, 0, 0] = maps[0, 1, 2, 4] = 1.0  # two: above to the left, below to the right
    features = softmax(maps).reshape(5, 2)
    th.testing.assert_close(features[:, 0], th.tensor([1.0, -1.0, 0.0, 0.0, 0.0]))
    th.testing.assert_close(features[:, 1], th.tensor([0.0, 0.0, 4.0, 1.0, 2.0]))


def test_spatial_softmax_sees_weak_maps_as_strong_ones():
    softmax, maps = SpatialSoftmax(2, 8, 8), th.randn(20, 2, 8, 8)
    th.testing.assert_close(softmax(0.05 * maps + 3.0), softmax(maps), atol=1e-2, rtol=1e-2)
    assert softmax(maps)[:, :4].std(dim=0).min() > 0.1  # pixels


def test_spatial_softmax_puts_what_a_flat_map_shows_in_the_middle():
    maps = th.full((1, 1, 3, 5), 0.7, requires_grad=True)
    features = SpatialSoftmax(1, 3, 5)(maps)
    th.testing.assert_close(features[0], th.tensor([0.0, 0.0, 2.0, 2 / 3, 0.0]))
    features.sum().backward()
    assert maps.grad.isfinite().all()


def test_spatial_softmax_learns_a_temperature_for_each_map():
    softmax, maps = SpatialSoftmax(2, 4, 4, temperature=0.5), th.randn(3, 2, 4, 4)
    with th.no_grad():
        softmax.log_temperature[1] = math.log(0.02)
    spread = softmax(maps).reshape(3, 5, 2)[:, 2:4].sum(dim=(0, 1))
    assert spread[1] < 0.5 * spread[0]
    softmax(maps)[:, 0].sum().backward()  # x of the first map
    gradient = softmax.log_temperature.grad
    assert gradient[0] != 0 and gradient[1] == 0


def test_spatial_softmax_keeps_its_precision_under_autocast():
    softmax, maps = SpatialSoftmax(2, 8, 8), 20 * th.randn(3, 2, 8, 8)
    expected = softmax(maps)
    with th.autocast("cpu", th.bfloat16):
        assert th.equal(softmax(maps), expected)


def test_an_encoder_with_spatial_softmax_gives_positions_unprojected():
    encoder = ConvEncoder(SPACE, n_filters=4, strides=(2, 2), spatial_softmax=True)
    assert encoder.features_dim == 20
    images = th.rand(2, *SPACE.shape).to(memory_format=th.channels_last)
    features = encoder(images)
    assert features.shape == (2, 20)
    assert th.equal(encoder.make_projection()(features), features)
    # Darker or brighter by the same amount everywhere is the same place, since nothing is cut off after the last layer
    bare = ConvEncoder(SPACE, n_filters=4, strides=(2,), spatial_softmax=True)
    th.testing.assert_close(bare(images), bare(images + 0.3), atol=1e-5, rtol=1e-4)


def test_a_combined_encoder_gives_positions_of_images_and_projects_vectors():
    space = spaces.Dict(image=SPACE, second=SPACE, vector=spaces.Box(-1.0, 1.0, (3,), np.float32))
    encoder = CombinedEncoder(space, cnn_output_dim=6, n_filters=4, strides=(2, 2), hidden_dim=7, spatial_softmax=True)
    assert encoder.features_dim == 2 * 20 + 6
    trunk_features = encoder({"image": th.rand(2, *SPACE.shape), "second": th.rand(2, *SPACE.shape), "vector": th.rand(2, 3)})
    assert trunk_features.shape == (2, 2 * 20 + 7)
    projected = encoder.make_projection()(trunk_features)
    assert projected.shape == (2, encoder.features_dim)
    assert th.equal(projected[:, :40], trunk_features[:, :40])
    assert projected[:, 40:].abs().max() < 1


@pytest.mark.parametrize("policy", ["CnnPolicy", "MultiInputPolicy"])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_trains_an_encoder_with_spatial_softmax_and_loads_it(name, policy, tmp_path):
    env = DotEnv(obs_type="pixels" if policy == "CnnPolicy" else "dict")
    kwargs = dict(features_extractor_kwargs=dict(n_filters=4, strides=(2, 2), spatial_softmax=True), net_arch=[16])
    model = ALGORITHMS[name](policy, env, policy_kwargs=kwargs, learning_starts=10, batch_size=8, buffer_size=100, seed=0)
    before = [parameter.detach().clone() for parameter in model.critic.features_extractor.parameters()]
    model.learn(30)
    after = list(model.critic.features_extractor.parameters())
    assert not any(th.equal(old, new) for old, new in zip(before, after, strict=True))
    model.save(tmp_path / "model.zip")
    observation, _ = env.reset(seed=0)
    action, _ = model.predict(observation, deterministic=True)
    loaded, _ = ALGORITHMS[name].load(tmp_path / "model.zip").predict(observation, deterministic=True)
    assert np.array_equal(action, loaded)


def test_spatial_softmax_sees_where_two_equal_dots_are_sooner():
    def error(**options) -> float:
        th.manual_seed(0)
        encoder = ConvEncoder(SPACE, n_filters=8, strides=(2, 2), center=True, **options)
        head = nn.Sequential(nn.Linear(encoder.features_dim, 64), nn.ReLU(), nn.Linear(64, 3))
        network = nn.Sequential(encoder, encoder.make_projection(), head)
        optimizer = th.optim.Adam(network.parameters(), lr=2e-3)
        losses = []
        for _ in range(100):
            places = th.randint(2, 29, (32, 2, 2))  # image, dot, row and column
            pixels = th.stack(th.meshgrid(th.arange(32), th.arange(32), indexing="ij"))
            offsets = pixels - places[..., None, None]
            dots = ((offsets >= 0) & (offsets < 2)).all(dim=2).any(dim=1)
            images = 0.9 - 0.7 * dots[:, None] * th.tensor([1.0, 1.0, 0.0])[:, None, None]
            first, second = (places / 16.0 - 1.0).unbind(dim=1)
            target = th.cat([(first + second) / 2, (first - second).norm(dim=1, keepdim=True)], dim=1)
            loss = (network(images) - target).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
        return float(np.mean(losses[-20:]))

    positions, flat = error(spatial_softmax=True), error()
    assert positions < 0.5 * flat, (positions, flat)

"""What the encoders do to images."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_por.encoders import CenteredConv2d, CombinedEncoder, ConvEncoder

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

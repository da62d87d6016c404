"""Observation encoders: a trunk that actor and critic may share, and the projection that each of them owns."""

import math
from collections.abc import Sequence
from typing import ClassVar

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import TensorDict
from torch import nn


class Projection(nn.Module):
    """
    Linear, layer norm and tanh on each block of a trunk's output; the results are concatenated.

    :param block_dims: Size of each block of the trunk's output
    :param features_dim: Size of one projected block
    :param n_positions: Number of leading features that are not projected
    """

    def __init__(self, block_dims: Sequence[int], features_dim: int, n_positions: int = 0):
        super().__init__()
        self.block_dims = list(block_dims)
        self.n_positions = n_positions
        self.blocks = nn.ModuleList()
        for block_dim in self.block_dims:
            linear = nn.Linear(block_dim, features_dim)
            nn.init.orthogonal_(linear.weight)
            nn.init.zeros_(linear.bias)
            self.blocks.append(nn.Sequential(linear, nn.LayerNorm(features_dim), nn.Tanh()))

    def forward(self, trunk_features: th.Tensor) -> th.Tensor:
        positions, *blocks = trunk_features.split([self.n_positions, *self.block_dims], dim=1)
        return th.cat([positions, *(project(block) for project, block in zip(self.blocks, blocks, strict=True))], dim=1)


class Encoder(BaseFeaturesExtractor):
    """
    A features extractor in two parts. ``forward`` is the trunk, which actor and critic can share; ``make_projection()`` builds
    the part that each network owns, so that the actor trains its projection while the trunk belongs to the critic (the
    convention of CURL and DrQ).

    ``features_dim`` is the size *after* the projection: the input of the actor's and the critic's heads.

    :param observation_space: Observation space
    :param block_dims: Size of each block of the trunk's output
    :param features_dim: Size of one projected block
    :param n_positions: Number of leading features that are not projected
    """

    def __init__(self, observation_space: gym.Space, block_dims: Sequence[int], features_dim: int, n_positions: int = 0):
        super().__init__(observation_space, n_positions + features_dim * len(block_dims))
        self.block_dims = list(block_dims)
        self.block_features_dim = features_dim
        self.n_positions = n_positions

    def make_projection(self) -> nn.Module:
        """
        :return: A new projection from the trunk's output to ``features_dim`` features
        """
        return Projection(self.block_dims, self.block_features_dim, self.n_positions)


def make_projection(features_extractor: nn.Module) -> nn.Module:
    """
    :param features_extractor: Any SB3 features extractor
    :return: A new projection for it; the identity for an extractor that is not an ``Encoder``
    """
    return features_extractor.make_projection() if isinstance(features_extractor, Encoder) else nn.Identity()


def delta_orthogonal_(weight: th.Tensor, gain: float) -> None:
    """
    Initialise a convolution kernel with zeros around an orthogonal centre tap (https://arxiv.org/abs/1806.05393).

    :param weight: Kernel of shape ``(out_channels, in_channels, height, width)``, changed in place
    :param gain: Scale of the centre tap
    """
    nn.init.zeros_(weight)
    with th.no_grad():
        nn.init.orthogonal_(weight[:, :, weight.shape[2] // 2, weight.shape[3] // 2], gain)


class CenteredConv2d(nn.Conv2d):
    """
    A convolution, without padding, of images in [0, 1] minus one half. The subtraction is folded into the bias and costs no
    pass over the images.
    """

    def forward(self, images: th.Tensor) -> th.Tensor:
        assert self.bias is not None
        offset = self.bias - 0.5 * self.weight.sum(dim=(1, 2, 3))
        return self._conv_forward(images, self.weight, offset)


def _from_middle(n: int) -> th.Tensor:
    """Positions of ``n`` pixels in a row, relative to their middle."""
    return th.arange(n) - (n - 1) / 2


class SpatialSoftmax(nn.Module):
    """
    Position of each map's large values: mean and covariance under a softmax over its pixels, with a learned temperature for
    each map. The means are the feature points of https://arxiv.org/abs/1504.00702. Two objects that look the same share one
    mean; the covariance holds their distance and direction. The temperature is in units of the map's standard deviation over
    its pixels, so that positions vary even where a filter responds weakly.

    :param n_maps: Number of maps
    :param height: Height of a map in pixels
    :param width: Width of a map in pixels
    :param temperature: Initial temperature in standard deviations of a map
    """

    #: Number of features of one map
    N_MOMENTS: ClassVar[int] = 5
    #: Smallest standard deviation by which a map is divided
    MIN_DEVIATION: ClassVar[float] = 1e-3

    monomials: th.Tensor

    def __init__(self, n_maps: int, height: int, width: int, temperature: float = 1.0):
        super().__init__()
        self.log_temperature = nn.Parameter(th.full((n_maps,), math.log(temperature)))
        rows, columns = th.meshgrid(_from_middle(height), _from_middle(width), indexing="ij")
        x, y = columns.flatten(), rows.flatten()
        self.register_buffer("monomials", th.stack([x, y, x * x, y * y, x * y]), persistent=False)

    def forward(self, maps: th.Tensor) -> th.Tensor:
        """
        :param maps: Shape ``(batch, n_maps, height, width)``
        :return: Means of x (to the right) and y (down), from the middle and in pixels of the maps, variances of x and y, and
            covariance, each of all maps, shape ``(batch, 5 * n_maps)``
        """
        # Pixels before maps, as in channels-last memory; float32, since a variance is a small difference of large numbers
        pixels = maps.permute(0, 2, 3, 1).flatten(1, 2).float()
        with th.autocast(maps.device.type, enabled=False):
            centered = pixels - pixels.mean(dim=1, keepdim=True)
            # th.var takes nine times as long; a constant map has equal shares
            variance = centered.square().mean(dim=1, keepdim=True) + self.MIN_DEVIATION**2
            shares = (centered * (variance.rsqrt() * th.exp(-self.log_temperature))).softmax(dim=1)
            x, y, xx, yy, xy = (self.monomials @ shares).unbind(dim=1)
        return th.cat([x, y, xx - x * x, yy - y * y, xy - x * y], dim=1)


def make_conv_trunk(
    image_shape: tuple[int, ...], n_filters: int, strides: Sequence[int], center: bool, spatial_softmax: bool = False
) -> tuple[nn.Sequential, int]:
    """
    3x3 convolutions with ReLU, then a flatten or a spatial softmax.

    :param image_shape: ``(channels, height, width)``
    :param n_filters: Filters of each layer
    :param strides: Stride of each layer
    :param center: Subtract one half from the images
    :param spatial_softmax: End with a spatial softmax of the last convolution, which has no ReLU then
    :return: The trunk, and the size of its output
    """
    layers: list[nn.Module] = []
    n_channels, height, width = image_shape
    for stride in strides:
        conv_class = CenteredConv2d if center and not layers else nn.Conv2d
        conv = conv_class(n_channels, n_filters, kernel_size=3, stride=stride)
        delta_orthogonal_(conv.weight, nn.init.calculate_gain("relu"))
        assert conv.bias is not None
        nn.init.zeros_(conv.bias)
        layers += [conv, nn.ReLU(inplace=True)]  # a second copy of each activation costs more than the function
        n_channels, height, width = n_filters, (height - 3) // stride + 1, (width - 3) // stride + 1
        if min(height, width) < 1:
            raise ValueError(
                f"Images of {image_shape[1]}x{image_shape[2]} pixels are too small for 3x3 convolutions with strides "
                f"{tuple(strides)}: use larger images or fewer and smaller strides (features_extractor_kwargs)."
            )
    if spatial_softmax:
        layers[-1] = SpatialSoftmax(n_channels, height, width)
        trunk_dim = SpatialSoftmax.N_MOMENTS * n_channels
    else:
        layers.append(nn.Flatten())
        trunk_dim = n_channels * height * width
    # With channels last the strided layers are 1.1-1.5 times as fast on CPU
    trunk = nn.Sequential(*layers)
    return trunk.to(memory_format=th.channels_last), trunk_dim  # type: ignore[call-overload]  # missing in PyTorch's stubs


class ConvEncoder(Encoder):
    """
    The convolutional encoder of CURL and DrQ: 3x3 convolutions, then Linear -> 50 -> LayerNorm -> tanh, as in DrQ. With
    ``spatial_softmax`` the features are positions in the image, without a projection; they locate small objects after fewer
    updates.

    :param observation_space: Image space, channels first
    :param features_dim: Size of the projected features; with ``spatial_softmax`` there are ``5 * n_filters`` features
    :param n_filters: Filters of each convolution
    :param strides: Stride of each convolution. (2, 1, 1, 1) in CURL, DrQ and at the paper's scale;
        the default costs a sixth of it and suits a laptop
    :param center: Subtract one half from the images, which are in [0, 1] then
    :param spatial_softmax: Use the positions of the last convolution's responses as features (``SpatialSoftmax``)
    :param normalized_image: The space holds images that are normalized already (``normalize_images=False``)
    """

    def __init__(
        self,
        observation_space: gym.Space,
        features_dim: int = 50,
        n_filters: int = 32,
        strides: Sequence[int] = (2, 2, 2, 1),
        center: bool = False,
        spatial_softmax: bool = False,
        normalized_image: bool = False,
    ):
        # An assertion as in SB3's NatureCNN: callers that handle the one handle the other
        assert is_image_space(observation_space, check_channels=False, normalized_image=normalized_image), (
            "CnnPolicy and ConvEncoder need images (a uint8 Box in [0, 255] of shape (channels, height, width)), "
            f"not {observation_space}. Use MlpPolicy for vectors, MultiInputPolicy for Dict observations, or "
            "policy_kwargs=dict(normalize_images=False) when the images are normalized already."
        )
        center = center and not normalized_image
        assert observation_space.shape is not None
        trunk, trunk_dim = make_conv_trunk(observation_space.shape, n_filters, strides, center, spatial_softmax)
        block_dims, n_positions = ([], trunk_dim) if spatial_softmax else ([trunk_dim], 0)
        super().__init__(observation_space, block_dims, features_dim, n_positions)
        self.trunk = trunk

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.trunk(observations.contiguous(memory_format=th.channels_last))


def make_vector_trunk(in_dim: int, hidden_dim: int) -> nn.Sequential:
    """
    :param in_dim: Size of the flattened observation
    :param hidden_dim: Size of the hidden layer
    :return: Flatten -> Linear -> ReLU
    """
    return nn.Sequential(nn.Flatten(), nn.Linear(in_dim, hidden_dim), nn.ReLU())


class VectorEncoder(Encoder):
    """
    A small MLP for observations other than images.

    :param observation_space: Observation space
    :param features_dim: Size of the projected features
    :param hidden_dim: Size of the hidden layer
    """

    def __init__(self, observation_space: gym.Space, features_dim: int = 50, hidden_dim: int = 256):
        super().__init__(observation_space, [hidden_dim], features_dim)
        self.trunk = make_vector_trunk(get_flattened_obs_dim(observation_space), hidden_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.trunk(observations)


class CombinedEncoder(Encoder):
    """
    For Dict observations: convolutions on every image, one small MLP on the concatenation of everything else.
    Each of these blocks gets its own projection.

    :param observation_space: Dict space
    :param cnn_output_dim: Size of one projected block (the name is that of SB3's ``CombinedExtractor``)
    :param n_filters: Filters of each convolution
    :param strides: Stride of each convolution, see ``ConvEncoder``
    :param hidden_dim: Size of the hidden layer for vectors
    :param center: Subtract one half from the images, which are in [0, 1] then
    :param spatial_softmax: Positions instead of blocks for images, see ``ConvEncoder``
    :param normalized_image: The space holds images that are normalized already (``normalize_images=False``)
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        cnn_output_dim: int = 50,
        n_filters: int = 32,
        strides: Sequence[int] = (2, 2, 2, 1),
        hidden_dim: int = 256,
        center: bool = False,
        spatial_softmax: bool = False,
        normalized_image: bool = False,
    ):
        center = center and not normalized_image
        trunks, image_dims, vector_dim = {}, [], 0
        vector_keys = []
        for key, space in observation_space.spaces.items():
            if is_image_space(space, normalized_image=normalized_image):
                assert space.shape is not None
                trunks[key], image_dim = make_conv_trunk(space.shape, n_filters, strides, center, spatial_softmax)
                image_dims.append(image_dim)
            else:
                vector_keys.append(key)
                vector_dim += get_flattened_obs_dim(space)
        block_dims, n_positions = ([], sum(image_dims)) if spatial_softmax else (image_dims, 0)
        if vector_dim > 0:
            block_dims.append(hidden_dim)

        super().__init__(observation_space, block_dims, cnn_output_dim, n_positions)
        self.vector_keys = vector_keys
        # A list, not a ModuleDict, whose keys may not be named "keys" or hold a point
        self.image_keys = list(trunks)
        self.image_trunks = nn.ModuleList(trunks.values())
        self.vector_trunk = make_vector_trunk(vector_dim, hidden_dim) if vector_dim > 0 else None

    def forward(self, observations: TensorDict) -> th.Tensor:
        blocks = [
            trunk(observations[key].contiguous(memory_format=th.channels_last))
            for key, trunk in zip(self.image_keys, self.image_trunks, strict=True)
        ]
        if self.vector_trunk is not None:
            vectors = [observations[key].flatten(start_dim=1) for key in self.vector_keys]
            blocks.append(self.vector_trunk(th.cat(vectors, dim=1)))
        return th.cat(blocks, dim=1)

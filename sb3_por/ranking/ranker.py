"""The ranker: a potential of images, and its file."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_por.common.errors import UserError, one_line
from sb3_por.common.files import atomic_write, check_output
from sb3_por.objectives.order_heads import DifferenceHead
from sb3_por.ranking.images import resize
from sb3_por.visual.encoders import ConvEncoder

#: Array of a ranker's file that holds JSON, beside those of the weights
FACTS = "facts"
SUFFIX = ".npz"
#: Largest size of a file after unpacking, and the sizes of images that a ranker may have
MAX_BYTES, MIN_SIZE, MAX_SIZE = 64 * 2**20, 32, 256
#: Images that pass the encoder at once
CHUNK = 256
#: Smallest rise of the raw potential from the first to the last frame of a video, and its smallest share of the range within
#: one: below is what rounding makes of videos that end as they begin
MIN_RISE, MIN_SHARE = 1e-4, 0.01


class Ranker(nn.Module):
    """
    A potential of images: POR's difference head on a convolutional encoder. On average it is 0 in the first frame of a video
    and 1 in the last one.

    :param image_size: Height and width in pixels to which images are resized
    :raises UserError: If ``image_size`` is out of range
    """

    start: th.Tensor
    rise: th.Tensor

    def __init__(self, image_size: int = 64):
        super().__init__()
        if isinstance(image_size, bool) or not isinstance(image_size, int) or not MIN_SIZE <= image_size <= MAX_SIZE:
            raise UserError(f"a ranker's images have {MIN_SIZE} to {MAX_SIZE} pixels a side, not {image_size!r:.40}")
        self.image_size = image_size
        space = spaces.Box(0, 255, (3, image_size, image_size), np.uint8)
        self.encoder = ConvEncoder(space, n_filters=16, center=True)
        self.projection = self.encoder.make_projection()
        self.head = DifferenceHead(self.encoder.features_dim, hidden_dim=256)
        self.register_buffer("start", th.zeros(()))
        self.register_buffer("rise", th.ones(()))
        #: JSON values on its origin
        self.facts: dict[str, Any] = {}

    def forward(self, images: th.Tensor) -> th.Tensor:
        """
        :param images: uint8, shape ``(batch, 3, image_size, image_size)``
        :return: The head's potential, in its own units, shape ``(batch,)``
        """
        return self.head.potential(self.projection(self.encoder(images.float() / 255)))

    def potential(self, frames: np.ndarray) -> np.ndarray:
        """
        :param frames: Images of any size, uint8, shape ``(n, height, width, channels)``
        :return: Potential of each, float32, shape ``(n,)``
        """
        images = as_tensor(resize(frames, self.image_size)).to(self.start.device)
        with th.no_grad():
            raw = th.cat([self(chunk) for chunk in images.split(CHUNK)])
            return ((raw - self.start) / self.rise).cpu().numpy()

    def calibrate(self, videos: list[np.ndarray]) -> None:
        """
        Choose the units: the mean potential becomes 0 in the first frames of these videos and 1 in their last ones.

        :param videos: Frames of each, see ``potential``
        :raises UserError: If the potential does not rise along the videos
        """
        with th.no_grad():
            self.start.zero_()
            self.rise.fill_(1.0)
        potentials = [self.potential(video) for video in videos]
        start, end = np.mean([(along[0], along[-1]) for along in potentials], axis=0)
        if not end - start > max(MIN_RISE, MIN_SHARE * np.mean([np.ptp(along) for along in potentials])):
            raise UserError(
                "nothing was learned: the potential does not rise along the videos; give more videos or updates, unless the "
                "videos end as they begin: then cut them where the task is done"
            )
        with th.no_grad():
            self.start.fill_(float(start))
            self.rise.fill_(float(end - start))

    def save(self, path: str | Path) -> None:
        """
        Write the weights and the facts to a file of plain arrays.

        :param path: ``.npz``
        :raises UserError: If the suffix is another or the folder cannot be written
        """
        path = check_output(path, (SUFFIX,))
        facts = json.dumps({**self.facts, "image_size": self.image_size})
        arrays = {name: tensor.cpu().numpy() for name, tensor in self.state_dict().items()}
        with atomic_write(path) as temporary:
            np.savez(temporary, **{FACTS: np.array(facts)}, **arrays)  # type: ignore[arg-type]  # numpy's stubs

    @classmethod
    def load(cls, path: str | Path) -> "Ranker":
        """
        Read a ranker, perhaps a stranger's: nothing is unpickled.

        :param path: File of ``save``
        :return: The ranker, on the CPU
        :raises UserError: If there is no such file, or it is no ranker
        """
        try:
            with zipfile.ZipFile(path) as archive:
                if sum(info.file_size for info in archive.infolist()) > MAX_BYTES:
                    raise ValueError(f"it unpacks to more than {MAX_BYTES >> 20} MiB")
            with np.load(path, allow_pickle=False) as arrays:
                facts = json.loads(str(arrays[FACTS]))
                tensors = {name: th.as_tensor(arrays[name]) for name in arrays.files if name != FACTS}
            ranker = cls(facts.pop("image_size"))
            ranker.load_state_dict(tensors)
        except FileNotFoundError as error:
            raise UserError(f"there is no ranker {path}; make one with python -m sb3_por rank") from error
        except (OSError, zipfile.BadZipFile, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
            raise UserError(f"{path} is not a ranker: {one_line(error)[:200]}") from error
        ranker.facts = facts
        return ranker


def as_tensor(frames: np.ndarray) -> th.Tensor:
    """
    :param frames: Shape ``(n, height, width, channels)``
    :return: The same with channels first
    """
    return th.as_tensor(frames).permute(0, 3, 1, 2)

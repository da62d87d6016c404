"""The frames of one batch and what the encoders make of them: each frame passes each encoder once per update."""

from typing import Any

import torch as th

#: All rows of a batch
ALL = slice(None)


def take_rows(observations: Any, rows: slice) -> Any:
    """
    :param observations: A tensor, or a dict of tensors
    :param rows: Rows to take
    :return: Views of these rows
    """
    if isinstance(observations, dict):
        return {key: value[rows] for key, value in observations.items()}
    return observations[rows]


class Views:
    """
    Augmented, preprocessed frames by name, and their encodings by the online encoder f_o and the momentum encoder f_m.

    Encodings are computed when first asked for and kept, so that the critic, the actor and the objective share them.
    Two names may stand for one frame (the same object): it is encoded once.

    :param critic: Owner of the online encoder: has ``trunk(observations)`` and ``projection(trunk_features)``
    :param critic_target: Owner of the momentum encoder
    :param frames: Preprocessed observations by name: ``"obs"`` (o_t), ``"next"`` (o_{t+1}), and what the objective
        asks for: ``"future"`` (o_{t+k}), ``"past"`` (o_{t-k}, for the first half of the batch), ``"positive"`` (another
        augmentation of o_t), ``"window"`` (o_{t+1..t+K})
    :param data: Other tensors by name that the objective may use: ``"actions"``, ``"past_gaps"``,
        ``"window_actions"``, ``"window_mask"``
    :param bfloat16: The trunks compute in lower precision; what they return is float32
    """

    def __init__(
        self,
        critic: Any,
        critic_target: Any,
        frames: dict[str, Any],
        data: dict[str, th.Tensor] | None = None,
        bfloat16: bool = False,
    ):
        self.critic = critic
        self.critic_target = critic_target
        self.bfloat16 = bfloat16
        self.frames = frames
        self.data = data or {}
        self.batch_size = len(next(iter(frames["obs"].values())) if isinstance(frames["obs"], dict) else frames["obs"])
        # By identity of the frame: trunk features of the leading rows with gradient; features of all rows without
        self._trunks: dict[int, th.Tensor] = {}
        self._features: dict[tuple[int, int], th.Tensor] = {}
        self._momentum: dict[int, th.Tensor] = {}

    def online(self, name: str, first: int | None = None) -> th.Tensor:
        """
        :param name: Name of a frame
        :param first: Encode only this number of leading rows; all by default
        :return: f_o of the frame, with gradient, shape ``(rows, features_dim)``
        """
        first = self.batch_size if first is None else first
        frame = self.frames[name]
        if (id(frame), first) not in self._features:
            pieces = [self._trunks[id(frame)]] if id(frame) in self._trunks else []
            n_encoded = sum(len(piece) for piece in pieces)
            if n_encoded < first:
                pieces.append(self.trunk_of(self.critic, take_rows(frame, slice(n_encoded, first))))
                self._trunks[id(frame)] = pieces[0] if len(pieces) == 1 else th.cat(pieces)
            self._features[id(frame), first] = self.critic.projection(self._trunks[id(frame)][:first])
        return self._features[id(frame), first]

    def momentum(self, name: str, rows: slice = ALL) -> th.Tensor:
        """
        :param name: Name of a frame
        :param rows: Rows to encode
        :return: f_m of the frame, without gradient, shape ``(rows, features_dim)``
        """
        frame = self.frames[name]
        with th.no_grad():
            if rows == ALL and id(frame) not in self._momentum:
                self._momentum[id(frame)] = self._encode_momentum(frame)
            if id(frame) in self._momentum:
                return self._momentum[id(frame)][rows]
            return self._encode_momentum(take_rows(frame, rows))

    def trunk_of(self, network: Any, observations: Any) -> th.Tensor:
        """
        :param network: A critic or an actor
        :param observations: Preprocessed observations
        :return: The features of its trunk, float32, shape ``(rows, trunk_dim)``
        """
        if not self.bfloat16:
            return network.trunk(observations)
        device = next(network.parameters()).device.type
        # Without the cache, which would keep weights that were cast where no gradient was wanted
        with th.autocast(device, th.bfloat16, cache_enabled=False):
            return network.trunk(observations).float()

    def _encode_momentum(self, observations: Any) -> th.Tensor:
        return self.critic_target.projection(self.trunk_of(self.critic_target, observations))

    def trunk(self, name: str) -> th.Tensor:
        """
        :param name: Name of a frame
        :return: The online trunk's features, detached, shape ``(batch, trunk_dim)``: the actor's input
        """
        encoded = self._trunks.get(id(self.frames[name]))
        n_encoded = 0 if encoded is None else len(encoded)
        pieces = [] if encoded is None else [encoded.detach()]
        if n_encoded < self.batch_size:
            with th.no_grad():
                pieces.append(self.trunk_of(self.critic, take_rows(self.frames[name], slice(n_encoded, None))))
        return pieces[0] if len(pieces) == 1 else th.cat(pieces)

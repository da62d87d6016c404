"""Running means that stay on the device until they are read."""

import torch as th


class RunningMeans:
    """Running means of named scalars, in constant memory."""

    def __init__(self) -> None:
        self._sums: dict[str, th.Tensor] = {}
        self._counts: dict[str, int] = {}

    def add(self, name: str, value: th.Tensor) -> None:
        """
        :param name: Name of the metric
        :param value: A scalar tensor; the host does not wait for it
        """
        value = value.detach().reshape(()).float()
        self._sums[name] = self._sums[name] + value if name in self._sums else value
        self._counts[name] = self._counts.get(name, 0) + 1

    def take(self) -> dict[str, float]:
        """
        :return: Mean of each metric since the last call; waits for the device, once
        """
        totals = th.stack(list(self._sums.values())).tolist() if self._sums else []
        means = {name: total / self._counts[name] for name, total in zip(self._sums, totals, strict=True)}
        self._sums.clear()
        self._counts.clear()
        return means

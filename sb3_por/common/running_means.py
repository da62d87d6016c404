"""Means of what an update measures, kept on the device until someone reads them."""

import torch as th


class RunningMeans:
    """Running means of named scalars; what they hold does not grow with the number of values."""

    def __init__(self) -> None:
        self._sums: dict[str, th.Tensor] = {}
        self._counts: dict[str, int] = {}

    def add(self, name: str, value: th.Tensor) -> None:
        """
        :param name: what is measured
        :param value: a scalar; nothing waits for its device
        """
        value = value.detach().reshape(()).float()
        self._sums[name] = self._sums[name] + value if name in self._sums else value
        self._counts[name] = self._counts.get(name, 0) + 1

    def take(self) -> dict[str, float]:
        """The means of all values since the last time; waits, once, for their device."""
        totals = th.stack(list(self._sums.values())).tolist() if self._sums else []
        means = {name: total / self._counts[name] for name, total in zip(self._sums, totals, strict=True)}
        self._sums.clear()
        self._counts.clear()
        return means

"""
A device that a machine without a GPU can have: its tensors live in the host's memory, and it computes what the CPU computes,
bit for bit. But as on a GPU nothing may mix its tensors with those of the host, and what would make the host wait for it
is counted.

PyTorch takes one such device a process, and for good: use it in a process of its own.
"""

from collections import Counter
from types import SimpleNamespace

import torch as th
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

NAME = "simulated"
#: What makes a GPU tell the host a number, or a shape that depends on numbers
ASKING = {"_local_scalar_dense", "equal", "nonzero", "masked_select", "_unique2"}

#: Bytes of memory that the device says are free
memory = SimpleNamespace(free=2**30)
#: What the host has waited for: operation -> how often
waits: Counter = Counter()


class OnDevice(th.Tensor):
    """A tensor of the device."""

    @staticmethod
    def __new__(cls, held):
        properties = dict(strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype, device=f"{NAME}:0")
        return th.Tensor._make_wrapper_subclass(cls, held.size(), **properties)

    def __init__(self, held):
        self.held = held

    @classmethod
    def __torch_dispatch__(cls, operation, types, args=(), kwargs=None):
        return run(operation, args, kwargs or {})


class SimulatedDevice(TorchDispatchMode):
    """While it is active there is such a device."""

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        return run(operation, args, kwargs or {})


def run(operation, args, kwargs):
    """Run one operation of PyTorch, on the device if its tensors are there or its result should be."""
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, th.Tensor)]
    ours = {id(tensor.held): tensor for tensor in tensors if isinstance(tensor, OnDevice)}
    target = th.device(kwargs.get("device") or (NAME if ours else "cpu"))
    if not ours and target.type == "cpu":
        return operation(*args, **kwargs)
    name = operation.overloadpacket.__name__
    check(name, args, kwargs, tensors, bool(ours), target)

    def to_held(leaf):
        if isinstance(leaf, th.device):
            return th.device("cpu")
        return leaf.held if isinstance(leaf, OnDevice) else leaf

    def from_held(leaf):
        if not isinstance(leaf, th.Tensor):
            return leaf
        # Operations in place return what they were given
        return ours[id(leaf)] if id(leaf) in ours else OnDevice(leaf)

    result = operation(*tree_map(to_held, args), **tree_map(to_held, kwargs))
    assert all(tensor.shape == tensor.held.shape for tensor in ours.values()), f"{name} changed a shape in place"
    return result if target.type == "cpu" else tree_map(from_held, result)


def check(name, args, kwargs, tensors, from_device, target):
    """
    Count what the host waits for.

    :raises RuntimeError: If the operation mixes tensors of the device with those of the host, or the host does not wait for a
        copy to itself, and would read what is not there yet
    """
    is_copy = name in ("_to_copy", "copy_")
    mixed = len({tensor.device.type for tensor in tensors if tensor.dim() > 0}) > 1
    if mixed and not is_copy:
        raise RuntimeError(f"{name} got tensors of the device and of the host")
    blocking = not (kwargs.get("non_blocking") or (name == "copy_" and args[2:] == (True,)))
    to_host = from_device and target.type == "cpu"
    if to_host and not blocking:
        raise RuntimeError(f"{name} to the host without waiting for it")
    from_host = is_copy and any(tensor.device.type == "cpu" for tensor in tensors)
    # A mask is turned into indices first, whose number nobody knows before
    mask = name.startswith("index") and any(getattr(index, "dtype", None) == th.bool for index in tree_leaves(args[1]))
    if to_host or name in ASKING or mask or (from_host and blocking):
        waits[name] += 1


def start() -> None:
    """Make this process one that has the device."""
    module = SimpleNamespace(
        is_available=lambda: True,
        is_initialized=lambda: True,
        current_device=lambda: 0,
        device_count=lambda: 1,
        _is_in_bad_fork=lambda: False,
        manual_seed_all=lambda seed: None,
        get_amp_supported_dtype=lambda: [th.bfloat16],
        mem_get_info=lambda device: (memory.free, memory.free),
    )
    _setup_privateuseone_for_python_backend(NAME, module)
    # Modules keep their parameters when they move to the device, as they do with a GPU
    th.__future__.set_swap_module_params_on_conversion(True)
    # torch.tensor(..., device=...) makes a tensor of the host first, and shows how it gets to the device
    th._C._set_only_lift_cpu_tensors(True)
    SimulatedDevice().__enter__()

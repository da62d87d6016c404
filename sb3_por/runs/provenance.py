"""Provenance of a run: the code, the packages and the machine that its numbers come from."""

import os
import platform
import re
from pathlib import Path
from typing import Any

import psutil
import torch as th

from sb3_por.runs.versions import current_versions

#: Instruction sets of a processor that numerical libraries choose their code by
VECTOR_FLAGS = re.compile(r"sse\w*|ssse3|avx\w*|fma\d?|f16c|amx\w*|neon|asimd\w*|sve\w*|bf16")
#: Environment variables that make numerical libraries choose other code
VARIABLES = ("ATEN_CPU_CAPABILITY", "ONEDNN_MAX_CPU_ISA", "MKL_CBWR", "MKL_ENABLE_INSTRUCTIONS", "NPY_DISABLE_CPU_FEATURES")


def current_machine() -> str:
    """One line about the machine of this process: processor, accelerator, memory, versions."""
    parts = [
        f"{len(os.sched_getaffinity(0))} cores of {_processor()}",
        *([th.cuda.get_device_name()] if th.cuda.is_available() else []),
        f"{psutil.virtual_memory().total / 2**30:.0f} GiB",
        platform.system(),
        f"Python {platform.python_version()}",
        f"PyTorch {th.__version__}",
    ]
    return ", ".join(parts)


def current_provenance(threads: int) -> dict[str, Any]:
    """
    Everything that decides whether a run gives the same numbers again, to the last bit: see ``docs/reliability.md``.

    :param threads: PyTorch threads of the run; those of this process if not positive
    :return: Plain values by name: those of :func:`sb3_por.runs.versions.current_versions`, ``processor``, its vector
        instructions (``cpu_flags``), those that PyTorch uses (``cpu_capability``), ``threads``, ``accelerator``, and each of
        ``VARIABLES`` that is set
    """
    info = Path("/proc/cpuinfo")
    flags = re.findall(r"^(?:flags|Features)\s*:\s*(.+)", info.read_text(), re.MULTILINE) if info.is_file() else []
    return {
        **current_versions(),
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cpu_flags": " ".join(sorted(filter(VECTOR_FLAGS.fullmatch, flags[0].split()))) if flags else "",
        "cpu_capability": th.backends.cpu.get_cpu_capability(),
        "threads": threads if threads > 0 else th.get_num_threads(),
        "accelerator": th.cuda.get_device_name() if th.cuda.is_available() else "",
        **{name: os.environ[name] for name in VARIABLES if name in os.environ},
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    models = re.findall(r"model name\s*:\s*(.+)", info.read_text()) if info.is_file() else []
    return models[0].strip() if models else platform.machine()

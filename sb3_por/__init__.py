"""Stable-Baselines3 algorithms that learn from pixels with a representation objective."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_por.algorithms import ALGORITHMS
    from sb3_por.algorithms.sac_curl import SACCURL
    from sb3_por.algorithms.sac_drq import SACDrQ
    from sb3_por.algorithms.sac_mrq import SACMRQ
    from sb3_por.algorithms.sac_por import SACPOR
    from sb3_por.algorithms.sac_spr import SACSPR
    from sb3_por.algorithms.tqc_por import TQCPOR
    from sb3_por.visual.sac import VisualSAC
    from sb3_por.visual.tqc import VisualTQC

    __version__: str

__all__ = ["ALGORITHMS", "SACCURL", "SACMRQ", "SACPOR", "SACSPR", "TQCPOR", "SACDrQ", "VisualSAC", "VisualTQC", "__version__"]

#: Public name -> its module, which is imported when the name is first used: PyTorch takes seconds to import
_MODULES = {
    "ALGORITHMS": "sb3_por.algorithms",
    "SACCURL": "sb3_por.algorithms.sac_curl",
    "SACDrQ": "sb3_por.algorithms.sac_drq",
    "SACMRQ": "sb3_por.algorithms.sac_mrq",
    "SACPOR": "sb3_por.algorithms.sac_por",
    "SACSPR": "sb3_por.algorithms.sac_spr",
    "TQCPOR": "sb3_por.algorithms.tqc_por",
    "VisualSAC": "sb3_por.visual.sac",
    "VisualTQC": "sb3_por.visual.tqc",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("sb3-por")
    elif name in _MODULES:
        value = getattr(import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

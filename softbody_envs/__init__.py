"""SoftGym's five deformable-object tasks as Gymnasium environments on PyBullet; importing this package registers them."""

import sys

from softbody_envs.sim.banner import no_banner

try:
    with no_banner():
        import pybullet
except ImportError as error:  # pragma: no cover - depends on the machine
    raise ImportError(
        "softbody_envs needs pybullet 3.2.7. It has wheels for CPython 3.10 and 3.11 only "
        f"(this is Python {sys.version_info.major}.{sys.version_info.minor}): "
        "use Python 3.10 or 3.11, or build pybullet from source with numpy installed."
    ) from error

if not pybullet.isNumpyEnabled():  # pragma: no cover - depends on the build
    raise ImportError(
        "This pybullet was built without numpy and would return images as tuples (bullet#4523): "
        "install numpy first, then `pip install --no-build-isolation --no-binary pybullet pybullet==3.2.7`."
    )

from softbody_envs.registration import ENV_IDS, register_envs

register_envs()

__all__ = ["ENV_IDS"]

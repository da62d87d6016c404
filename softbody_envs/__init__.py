"""SoftGym's five deformable-object tasks as Gymnasium environments on PyBullet; importing this package registers them."""

import sys

from softbody_envs.sim.banner import no_banner

try:
    with no_banner():
        import pybullet  # noqa: F401
except ImportError as error:
    # The two distributions share these files: removing one of them breaks the other.
    raise ImportError(
        "softbody_envs needs the module pybullet, from the distribution pybullet or its fork pybullet-arm64, not both: "
        "`pip uninstall -y pybullet pybullet-arm64`, then install this project again, on Python 3.10 to 3.13 "
        f"(this is {sys.version_info.major}.{sys.version_info.minor})."
    ) from error

from softbody_envs.registration import ENV_IDS, register_envs

register_envs()

__all__ = ["ENV_IDS"]

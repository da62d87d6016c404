"""The table of environment ids."""

import gymnasium as gym

#: id -> (module:class under ``softbody_envs.tasks``, horizon in control steps of 0.08 s)
_TABLE = {
    "PourWater-v0": ("pour_water:PourWaterEnv", 100),
    "PourWaterAmount-v0": ("pour_water_amount:PourWaterAmountEnv", 100),
    "StraightenRope-v0": ("straighten_rope:StraightenRopeEnv", 75),
    "FoldCloth-v0": ("fold_cloth:FoldClothEnv", 100),
    "DropFoldCloth-v0": ("drop_fold_cloth:DropFoldClothEnv", 100),
    "FallingBall-v0": ("falling_ball:FallingBallEnv", 50),
    "SwingingBall-v0": ("swinging_ball:SwingingBallEnv", 100),
}

#: Every id that ``import softbody_envs`` registers.
ENV_IDS = tuple(_TABLE)


def register_envs() -> None:
    """Register every task with Gymnasium; importing again changes nothing."""
    for env_id, (entry_point, horizon) in _TABLE.items():
        if env_id not in gym.registry:
            gym.register(env_id, entry_point=f"softbody_envs.tasks.{entry_point}", max_episode_steps=horizon)

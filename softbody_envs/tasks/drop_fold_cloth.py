"""DropFoldCloth: lower a hanging cloth to the floor, folded in half."""

from typing import ClassVar

import numpy as np

from softbody_envs.rendering import Camera
from softbody_envs.sim.cloth import N_SIDE, flat_grid
from softbody_envs.sim.pickers import REACH
from softbody_envs.sim.world import World
from softbody_envs.tasks.fold_cloth import N_HALF, PICKER_RADIUS, SIZES, FoldClothEnv

#: Initial height of the pickers above the corners that they hold, m.
GRIP_HEIGHT = 0.05
#: Largest move of a picker along each axis in one control step, m.
PICKER_REACH = 0.03
#: Range of the initial height of the lower edge, m, before the weight stretches the cloth by about 3.5 cm.
DROP_HEIGHTS = (0.03, 0.05)
#: Largest angle between the direction of the fold and x, rad.
YAW = np.pi / 6
#: Control steps before an episode in which the cloth comes to rest; its velocities are set to zero after each.
SETTLE_STEPS = 5
#: Number of points on each side of the cloth in the state vector.
N_POINTS = 5


class DropFoldClothEnv(FoldClothEnv):
    """
    ## Description

    A cloth hangs from two pickers that hold its upper corners. Its lower edge is at the floor. Lay the cloth on the floor,
    folded in half: the lower edge stays where it is, the lower half lies behind it (toward -x), and the upper half lies on
    the lower half.

    Cloth and pickers are those of `FoldCloth-v0`.

    ## Action Space

    `Box(-1, 1, (8,), float32)`, for one control step of 0.08 s, as in `FoldCloth-v0` with smaller moves:

    | Num | Action | Meaning |
    |-----|--------|---------|
    | 0, 1, 2 | move picker 0 along x, y, z | 0.03 m in one step |
    | 3 | pick | above 0: hold, or grasp the nearest free node within 6.1 cm of the centre; otherwise: release |
    | 4, 5, 6 | move picker 1 along x, y, z | 0.03 m in one step |
    | 7 | pick | as 3 |

    The pickers hold the cloth at the start. If the pick of the first action is 0 or less, the cloth drops. The centres of
    the pickers stay within x = -0.6 to 0.3 m, y = -0.45 to 0.45 m and z = 0.05 to 0.85 m.

    ## Observation Space

    `obs_type="pixels"`: an RGB image. `obs_type="state"`: `Box(-10, 10, (62,), float32)`:

    | Num | Observation | Unit |
    |-----|-------------|------|
    | 0 to 5 | x, y, z of the two upper corners | m |
    | 6 to 11 | x, y, z of the lower corners, in the same order | m |
    | 12 to 17 | x, y, z of picker 0, then of picker 1 | m |
    | 18, 19 | whether picker 0 and picker 1 hold the cloth | 0 or 1 |
    | 20 to 25 | x, y, z of each picker's upper corner relative to that picker | 0.08 m |
    | 26 to 31 | x, y, z of the lower corners relative to the upper ones | 0.08 m |
    | 32 to 46 | x, y, z of five points of one side, from upper to lower corner, relative to the lower one's goal | 0.08 m |
    | 47 to 61 | the same for the other side | 0.08 m |

    Elements are clipped to the bounds, elements 20 to 61 therefore at 0.8 m.

    ## Rewards

    Each step: -(d + 7 f), where d is the mean distance between a node of the upper half and its mirror image in the lower
    half, and f is the mean distance of the lower half's nodes from their goals on the floor. Both distances are horizontal,
    in m. The middle row of nodes belongs to neither half.

    | `info` key | Meaning |
    |------------|---------|
    | `performance` | the reward |
    | `normalized_performance` | 1 - performance / initial |
    | `is_success` | `normalized_performance` is at least 0.9 |
    | `monotone` | minus the mean distance between the halves in space, m |

    Holding the cloth still scores 0, and so does releasing it, on average. Dropping the cloth in a heap at the best place
    scores up to 0.33. Laying out a quarter of its length, or the lower half, while the rest stands upright scores 0.76
    (calculated for ideal poses).

    ## Starting State

    The cloth hangs at rest in a plane through the z axis, with its lower edge on the floor or up to 1 cm above it.
    Variations differ in the height of the cloth (within 2 cm), in both of its side lengths (0.38 to 0.54 m) and in the
    angle between the direction of the fold and x (-30 to 30 degrees).

    ## Episode End

    Truncation after 100 steps (8 s). There is no termination. If the simulation fails (an edge is longer than 4 times
    its rest length), the episode is truncated with `info["sim_error"]`, and the next one starts in a new world.

    ## Arguments

    See `SoftbodyEnv`, and

    * `keep_hold` (default `False`): pickers hold the cloth for the whole episode, regardless of actions 3 and 7. Only the
      motion of the pickers remains to be learned. The task can be solved without releasing.

    ## Differences from SoftGym

    In SoftGym a perfect fold on the floor scores less than holding the cloth still, because the goal of the lower half is
    its position at reset, in the air. The pickers cannot reach the floor either. Therefore:

    * The goal of the lower half is flat on the floor.
    * Distances are horizontal. In space, releasing the cloth would score 0.7, since a heap on the floor is closer to the
      goals than a cloth in the air.
    * The weight of f is 7 instead of 1.2. With a smaller weight, laying out the lower half would score less than laying out
      a quarter of the cloth (with 1.2: -0.37 and 0.43), and a learner would stop there.
    * The pickers reach the floor, and they hold the cloth at the start. In SoftGym they are only near it.
    * The lower edge starts at the floor. From higher up, the first steps toward the fold would score nothing, while
      carrying the cloth forward in the air would score 0.33 and lead nowhere.
    * Pickers move 0.03 m in one step instead of 0.08 m. Larger random moves would drag the cloth away during exploration.
    * The state also contains the sides of the cloth relative to its goal. Corners and pickers alone do not show where a
      moved cloth was at the start, how much of it lies on the floor, or to which side it bulges.
    * The cloth hangs at x = 0 and at an angle. In SoftGym it hangs up to 0.1 m away; images after the start would not show
      where its goal is.
    * The differences of cloth and pickers listed for `FoldCloth-v0` apply.

    ## Version History

    * v0: initial version
    """

    scenes: ClassVar[str] = "DropFoldClothEnv"
    expert: ClassVar[str | None] = "softbody_envs.experts.drop_fold_cloth:DropFoldClothExpert"
    camera: ClassVar[Camera] = Camera(position=(0.70, -1.00, 1.0), target=(-0.08, 0.0, 0.33))
    workspace: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = ((-0.6, -0.45, PICKER_RADIUS), (0.3, 0.45, 0.85))
    state_names: ClassVar[tuple[str, ...]] = (
        *FoldClothEnv.state_names,
        *(f"side {side} point {point} {axis}" for side in range(2) for point in range(N_POINTS) for axis in "xyz"),
    )
    picker_reach: ClassVar[float] = PICKER_REACH
    fixation_weight: ClassVar[float] = 7.0
    measured_axes: ClassVar[int] = 2

    def _build(self, world: World, rng: np.random.Generator) -> None:
        length, width = rng.uniform(*SIZES, 2)
        yaw = rng.uniform(-YAW, YAW)
        bottom = rng.uniform(*DROP_HEIGHTS)
        flat = flat_grid(length, width, yaw) - length / 2 * np.array([np.cos(yaw), np.sin(yaw), 0.0])
        hanging = np.broadcast_to(flat[-1], flat.shape).copy()
        hanging[..., 2] = bottom + np.linspace(length, 0, N_SIDE)[:, None]
        hanging += rng.uniform(-5e-4, 5e-4, hanging.shape)  # a perfect plane would fall onto a line
        self._furnish(world, hanging, [(x, y, z + GRIP_HEIGHT) for x, y, z in hanging[0, [0, -1]]])
        hold = np.tile([0.0, 0.0, 0.0, 1.0], 2)
        for _ in range(SETTLE_STEPS):
            self.pickers.control(hold)
            self.cloth.calm()
        self._locate()
        self._place = flat[: -N_HALF - 1 : -1]

    def _measure(self) -> np.ndarray:
        sides = self._grid[:: (N_SIDE - 1) // (N_POINTS - 1), [0, -1]] - self._place[0, [0, -1]]
        return np.concatenate([super()._measure(), (sides / REACH).transpose(1, 0, 2).ravel()])

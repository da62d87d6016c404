"""DropFoldCloth: lay a hanging cloth on the floor, folded in half."""

from typing import ClassVar

import numpy as np

from softbody_envs.rendering import Camera
from softbody_envs.sim.cloth import N_SIDE, flat_grid
from softbody_envs.sim.pickers import REACH
from softbody_envs.sim.world import World
from softbody_envs.tasks.fold_cloth import N_HALF, PICKER_RADIUS, SIZES, FoldClothEnv

#: The pickers hold the two upper corners from this far above, m.
GRIP_HEIGHT = 0.05
#: Farthest that a picker moves along each axis in one control step, m.
PICKER_REACH = 0.03
#: Height of the lower edge at first, m, before its weight stretches the cloth by some 3.5 cm.
DROP_HEIGHTS = (0.03, 0.05)
#: Greatest angle between the direction of the fold and x, rad.
YAW = np.pi / 6
#: Control steps after which the cloth hangs still; each ends with its velocities taken away.
SETTLE_STEPS = 5
#: How many points of each side of the cloth the state shows.
N_POINTS = 5


class DropFoldClothEnv(FoldClothEnv):
    """
    ## Description

    A cloth hangs from two pickers that hold its upper corners; its lower edge just touches the floor. Lay it on the floor,
    folded in half: the lower edge stays where it is, the lower half goes behind it (toward -x), and the upper half on the
    lower.

    The cloth and the pickers are those of `FoldCloth-v0`.

    ## Action Space

    `Box(-1, 1, (8,), float32)`, as in `FoldCloth-v0`: x, y, z and pick of picker 0, then of picker 1. The pickers hold
    the cloth at first; the first action decides whether they keep it: a pick of 0 or less drops it. A picker moves 0.03 m
    in one step. With `keep_hold=True` neither ever lets go, whatever elements 3 and 7 say.

    The centres of the pickers stay within x = -0.6 to 0.3 m, y = -0.45 to 0.45 m and z = 0.05 to 0.85 m.

    ## Observation Space

    `obs_type="pixels"`: an RGB image. `obs_type="state"`: `Box(-10, 10, (62,), float32)`:

    | Num | Observation | Unit |
    |-----|-------------|------|
    | 0 to 5 | x, y, z of the two upper corners | m |
    | 6 to 11 | x, y, z of the lower corners, in the same order | m |
    | 12 to 17 | x, y, z of picker 0, then of picker 1 | m |
    | 18, 19 | whether picker 0, picker 1 holds the cloth | 0 or 1 |
    | 20 to 25 | x, y, z of the upper corner of each picker, seen from that picker | 0.08 m |
    | 26 to 31 | x, y, z of the lower corners, seen from the upper ones | 0.08 m |
    | 32 to 46 | x, y, z of five points of one side, from the upper corner to the lower, seen from the place of that | 0.08 m |
    | 47 to 61 | the same of the other side | 0.08 m |

    Elements are clipped at their bounds: what is farther than 0.8 m, elements 20 to 61 do not tell.

    ## Rewards

    Each step: -(d + 7 f). d is the mean distance between a node of the upper half and its mirror image in the lower half,
    f the mean distance of the lower half's nodes from where they belong on the floor, both in m and both horizontal, as
    seen from above. The middle row of nodes counts in neither.

    `performance` is this reward; `normalized_performance` = 1 - performance / initial performance; `is_success` from 0.9
    on; `monotone` is minus the distance between the halves in space, m.

    Holding the cloth still scores 0, and so, on average, does letting go. A cloth that is dropped in a heap on the best
    place can reach 0.33, one that is laid out up to a quarter of its length or to the fold while the rest stands there
    0.76 (calculated from ideal poses).

    ## Starting State

    The cloth at rest, its lower edge on the floor or up to 1 cm above it, its plane through the z axis. A variation draws
    how high it hangs (from a range of 2 cm), both sides of the cloth (0.38 to 0.54 m) and the angle between the direction
    of the fold and x (up to 30 degrees either way).

    ## Episode End

    Truncation after 100 steps (8 s). There is no termination. Should the simulation fail (an edge of more than 4 times
    its length), the episode is truncated with `info["sim_error"]`, and the next one starts in a new world.

    ## Arguments

    See `SoftbodyEnv`, and

    * `keep_hold` (default `False`): the pickers hold the cloth for the whole episode; what is left to decide is where they
      go. The cloth can be folded without letting go.

    ## Differences from SoftGym

    In SoftGym a perfect fold on the floor scores less than holding the cloth still: the lower half is to stay where it
    was at reset, in the air. And the pickers cannot reach the floor. Repaired:

    * The lower half belongs flat on the floor.
    * Distances are horizontal. In space, letting go would score 0.7, since a heap on the floor is nearer to everything
      than a cloth in the air.
    * The lower half weighs 7, not 1.2: with less than 7 a cloth whose lower half is laid out would score less than one
      of which a quarter is (with 1.2 -0.37 and 0.43), and a learner would stop there.
    * The pickers reach the floor, and they hold the cloth at the start instead of only being near it.
    * The lower edge is at the floor at first. Higher up, the first steps of the way to the fold score nothing, and to carry
      the cloth forward in the air scores 0.33 and leads nowhere.
    * Pickers move 0.03 m in one step, not 0.08 m: random ones, or those of a policy that explores, drag away what is laid.
    * The state also says where the cloth belongs, and how its sides run. Corners and pickers do not tell where a cloth that
      has been moved hung, how much of it is laid, or which way it bulges.

    And:

    * The cloth hangs at x = 0 (SoftGym: up to 0.1 m beside it), for its goal would be seen in no image after the start;
      it hangs at an angle instead.
    * What is said of the cloth and the pickers at `FoldCloth-v0`.

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

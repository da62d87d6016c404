"""StraightenRope: take a crumpled rope by its ends and pull it straight."""

from typing import ClassVar

import numpy as np

from softbody_envs.painting import paint_shadows
from softbody_envs.rendering import Camera
from softbody_envs.sim.pickers import REACH, Pickers
from softbody_envs.sim.rope import LENGTH, STEPS_PER_CONTROL, Rope, end_distance, failure
from softbody_envs.sim.rope_bank import crumpled
from softbody_envs.sim.world import World
from softbody_envs.tasks.picker_env import PickerEnv

PICKER_RADIUS = 0.02
#: SoftGym: picker radius 0.02 + particle radius 0.025 + threshold 0.005.
GRASP_RANGE = 0.05
PICKER_STARTS = np.array([(0.0, 0.04, 0.10), (0.0, -0.04, 0.10)])
#: The box that the pickers' centres stay in, m.
LOW = np.array([-0.28, -0.28, 0.02])
HIGH = np.array([0.28, 0.28, 0.20])
#: The nodes that the state tells of: SoftGym's 0, 4, ..., 32, 40 of 41 particles.
KEY_NODES = (0, 2, 4, 6, 8, 10, 12, 14, 16, 20)


class StraightenRopeEnv(PickerEnv):
    """
    ## Description

    A crumpled rope lies on the floor, seen from straight above. Two pickers hover over it. Straighten it: bring its ends as
    far apart as the rope is long.

    The rope is 0.5 m long: 20 rigid segments in a chain, in Bullet's rigid world. It is blue with yellow ends. A picker is a
    sphere, red or green, dark while it holds something; the farther its shadow is from it the higher it is.

    ## Action Space

    `Box(-1, 1, (8,), float32)`, for one control step of 0.08 s:

    | Num | Action | Meaning |
    |-----|--------|---------|
    | 0, 1, 2 | move the red picker along x, y, z | 0.08 m in one step |
    | 3 | pick | above 0: hold, or take the nearest free node within 5 cm of the centre; otherwise: let go |
    | 4, 5, 6 | move the green picker along x, y, z | 0.08 m in one step |
    | 7 | pick | as 3 |

    x points right in the image, y up, z toward the camera. The centres of the pickers stay within x, y = -0.28 to 0.28 m and
    z = 0.02 to 0.20 m. A picker keeps the offset at which it took a node. It pulls with 2.5 N at most (the rope weighs 1 N):
    when the rope cannot follow it stays behind. Two pickers that hold the rope cannot be sent farther apart than the rope
    between them is long. With `keep_hold=True` both hold all the time, whatever elements 3 and 7 say.

    ## Observation Space

    `obs_type="pixels"`: an RGB image. `obs_type="state"`: `Box(-10, 10, (50,), float32)`:

    | Num | Observation | Unit |
    |-----|-------------|------|
    | 0 to 29 | x, y, z of the nodes 0, 2, 4, 6, 8, 10, 12, 14, 16 and 20 of 0..20; 0 and 20 are the ends | m |
    | 30 to 35 | x, y, z of the red picker, then of the green one | m |
    | 36, 37 | whether the red, the green picker holds the rope | 0 or 1 |
    | 38 to 49 | x, y, z of node 0 and of node 20, seen from the red picker, then from the green one | 0.08 m |

    ## Rewards

    Each step: -|d - 0.5|, d being the distance between the ends in m.

    `performance` is this reward; `normalized_performance` = 1 - performance / initial performance; `is_success` from 0.9
    on; `monotone` is d.

    ## Starting State

    A rope at rest, made as in SoftGym: four times, some node of a straight rope is pulled for 0.64 s in a random
    direction and dropped. Each variation has a rope of its own, turned by a random angle and centred. The ends are at most
    0.35 m apart and nothing lies on them. The pickers are 10 cm above the floor, 4 cm to either side of the middle.

    ## Episode End

    Truncation after 75 steps (6 s). There is no termination. Should the simulation fail (a rope that is a fifth longer or
    shorter than it was), the episode is truncated with `info["sim_error"]`, and the next one starts in a new world.

    ## Arguments

    See `SoftbodyEnv`, and

    * `keep_hold` (default `False`): a picker takes the rope when it comes near it and never lets go; what is left to decide
      is where the pickers go.

    ## Differences from SoftGym

    * `normalized_performance` is relative to the start, so that doing nothing scores 0. SoftGym divides by the length: an
      untouched rope scores well above 0 there.
    * The rope keeps its length within 5 %, whatever the pickers do. SoftGym's has 7.5 % of slack and can be stretched.
    * 21 nodes instead of 41 particles; the state has the same ten of them, and says which picker holds something and
      where the ends are from each picker, in units of what it moves in one step: with positions alone a learner remembers
      ropes instead of reaching for ends.
    * A start with its ends farther apart than 0.35 m, or under the rest of the rope, is drawn again: little would be left
      to do, or the image would not show what to do.
    * The ends are marked: in a heap of rope they look like bends.
    * Pickers do not push the rope. Their box is smaller (0.33 m and 0.28 m in SoftGym) and the camera higher (0.85 m
      there): the pickers never leave the image. Only they cast shadows, on the floor; in SoftGym all things do.

    ## Version History

    * v0: initial version
    """

    scenes: ClassVar[str] = "StraightenRopeEnv"
    expert: ClassVar[str | None] = "softbody_envs.experts.straighten_rope:StraightenRopeExpert"
    camera: ClassVar[Camera] = Camera(position=(0.0, 0.0, 0.93), target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    state_names: ClassVar[tuple[str, ...]] = (
        *(f"node {node} {axis}" for node in KEY_NODES for axis in "xyz"),
        *(f"picker {picker} {axis}" for picker in (0, 1) for axis in "xyz"),
        "picker 0 holds",
        "picker 1 holds",
        *(f"end {end} from picker {picker} {axis}" for picker in (0, 1) for end in (0, 1) for axis in "xyz"),
    )
    best_performance: ClassVar[float] = 0.0
    success_threshold: ClassVar[float] = 0.9
    steps_per_control: ClassVar[int] = STEPS_PER_CONTROL

    def _build(self, world: World, rng: np.random.Generator) -> None:
        self._floor = world.add_floor()
        self.rope = Rope(world, crumpled(self.variation, rng))
        self.pickers = Pickers(world, self.rope, PICKER_STARTS, LOW, HIGH, PICKER_RADIUS, GRASP_RANGE)
        self._locate()

    def _locate(self) -> None:
        self._nodes = self.rope.nodes()

    def fault(self) -> str | None:
        return failure(self._nodes)

    def _measure(self) -> np.ndarray:
        holds = [float(node is not None) for node in self.pickers.held]
        pickers = self.pickers.positions
        reaches = (self._nodes[[0, -1]] - pickers[:, None]) / REACH
        return np.concatenate([self._nodes[list(KEY_NODES)].ravel(), pickers.ravel(), holds, reaches.ravel()])

    def _image(self, size: int) -> np.ndarray:
        frame, depth = self.renderer.render(self.world, self.camera, size)
        paint_shadows(frame, depth, self.camera, self._floor, self.pickers.positions, PICKER_RADIUS)
        return frame

    def performance(self) -> float:
        """How far the distance between the ends is from the rope's length, m, negative."""
        return -abs(self.monotone() - LENGTH)

    def monotone(self) -> float:
        """Distance between the ends, m."""
        return end_distance(self._nodes)

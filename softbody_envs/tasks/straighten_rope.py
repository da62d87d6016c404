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
#: Corners of the box that the centres of the pickers stay in, m.
LOW = np.array([-0.28, -0.28, 0.02])
HIGH = np.array([0.28, 0.28, 0.20])
#: Nodes in the state vector. In SoftGym: 0, 4, ..., 32 and 40 of 41 particles.
KEY_NODES = (0, 2, 4, 6, 8, 10, 12, 14, 16, 20)


class StraightenRopeEnv(PickerEnv):
    """
    ## Description

    A crumpled rope lies on the floor, seen from directly above. Two pickers hover over it. Straighten the rope: pull its
    ends apart until their distance is its length.

    The rope is a chain of 20 rigid segments, 0.5 m long, blue with a yellow end (node 0) and a magenta one (node 20). The
    pickers are a red and a green sphere. They are darker while they hold something. The distance of a picker from its shadow
    shows its height.

    ## Action Space

    `Box(-1, 1, (8,), float32)`, for one control step of 0.08 s:

    | Num | Action | Meaning |
    |-----|--------|---------|
    | 0, 1, 2 | move the red picker along x, y, z | 0.08 m in one step |
    | 3 | pick | above 0: hold, or grasp the nearest free node within 5 cm of the centre; otherwise: release |
    | 4, 5, 6 | move the green picker along x, y, z | 0.08 m in one step |
    | 7 | pick | as 3 |

    x points right in the image, y up, z toward the camera. The centres of the pickers stay within x, y = -0.28 to 0.28 m and
    z = 0.02 to 0.20 m. A picker keeps the offset at which it grasped a node. Its force is limited to 2.5 N (the rope weighs
    1 N): it lags behind if the rope cannot follow. Two pickers that hold the rope cannot move farther apart than the length
    of the rope between them.

    ## Observation Space

    `obs_type="pixels"`: an RGB image. `obs_type="state"`: `Box(-10, 10, (50,), float32)`:

    | Num | Observation | Unit |
    |-----|-------------|------|
    | 0 to 29 | x, y, z of the nodes 0, 2, 4, 6, 8, 10, 12, 14, 16 and 20 of 0..20; 0 and 20 are the ends | m |
    | 30 to 35 | x, y, z of the red picker, then of the green one | m |
    | 36, 37 | whether the red and the green picker hold the rope | 0 or 1 |
    | 38 to 49 | x, y, z of node 0 and of node 20 relative to the red picker, then to the green one | 0.08 m |

    ## Rewards

    Each step: -|d - 0.5|, where d is the distance between the ends in m.

    | `info` key | Meaning |
    |------------|---------|
    | `performance` | the reward |
    | `normalized_performance` | 1 - performance / initial |
    | `is_success` | `normalized_performance` is at least 0.9 |
    | `monotone` | d, m |

    ## Starting State

    The rope is at rest. It was crumpled as in SoftGym: four times, a random node of a straight rope was pulled for 0.64 s
    in a random direction and dropped. Each variation has its own rope, rotated by a random angle and centred. The ends are
    at most 0.35 m apart, and nothing lies on them. The pickers are 10 cm above the floor, 4 cm to either side of the middle.

    ## Episode End

    Truncation after 75 steps (6 s). There is no termination. If the simulation fails (the length of the rope changes
    by more than a fifth), the episode is truncated with `info["sim_error"]`, and the next one starts in a new world.

    ## Arguments

    See `SoftbodyEnv`, and

    * `keep_hold` (default `False`): pickers grasp the rope when they reach it and never release it, regardless of actions 3
      and 7. Only the motion of the pickers remains to be learned.

    ## Differences from SoftGym

    * `normalized_performance` is relative to the start: doing nothing scores 0. SoftGym divides by the length of the rope,
      so that an untouched rope scores well above 0.
    * The rope keeps its length within 5 %, whatever the pickers do. SoftGym's rope has 7.5 % of slack and can be stretched.
    * The rope has 21 nodes instead of 41 particles. The state contains the same ten of them and, in addition, which pickers
      hold something and where the ends are relative to the pickers, in units of a picker's largest move. With positions
      alone, a learner memorizes ropes instead of reaching for their ends.
    * Starts whose ends are farther apart than 0.35 m or lie under the rope are excluded: there would be little to do, or
      the image would not show what to do.
    * The ends are marked. Otherwise they look like bends in a heap of rope.
    * Pickers do not push the rope. Their box is smaller (SoftGym: 0.33 m and 0.28 m) and the camera is higher (SoftGym:
      0.85 m), so that the pickers never leave the image. Only they cast shadows, on the floor; in SoftGym all objects do.

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
        """Minus the difference between the distance of the ends and the length of the rope, m."""
        return -abs(self.monotone() - LENGTH)

    def monotone(self) -> float:
        """Distance between the ends, m."""
        return end_distance(self._nodes)

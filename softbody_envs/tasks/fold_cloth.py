"""FoldCloth: fold a cloth in half with two pickers."""

from typing import ClassVar

import numpy as np

from softbody_envs.painting import paint_shadows, paint_sheet
from softbody_envs.rendering import Camera
from softbody_envs.sim.cloth import N_SIDE, STEPS_PER_CONTROL, Cloth, flat_grid
from softbody_envs.sim.pickers import REACH, Pickers
from softbody_envs.sim.world import World
from softbody_envs.tasks.picker_env import PickerEnv

#: Radius of the pickers, m, and largest distance from their centres to a node that they can grasp, m (in SoftGym: radius
#: of the picker, threshold, and radius of a particle).
PICKER_RADIUS = 0.05
GRASP_RANGE = PICKER_RADIUS + 0.005 + 0.00625
#: Mass of a picker, kg: large enough that the cloth does not slow it down.
PICKER_MASS = 100.0
#: Initial height of the pickers, m, and their distance from the middle of the edge to carry, m.
PICKER_HEIGHT = 0.10
PICKER_OFFSET = 0.10
#: Range of the side lengths of the cloth, m.
SIZES = (0.38, 0.54)
#: Control steps before an episode in which the cloth comes to rest.
SETTLE_STEPS = 2
#: Rows of nodes in each half of the cloth; the middle row belongs to neither.
N_HALF = N_SIDE // 2
FACE = (0.86, 0.27, 0.55)
UNDERSIDE = (0.98, 0.80, 0.30)


class FoldClothEnv(PickerEnv):
    """
    ## Description

    A cloth lies flat on the floor. Two pickers start above one of its edges. Grasp the corners of that edge, carry it over
    the cloth and lay it on the opposite edge: one half should lie on the other, and the other half should not move.

    The cloth is a mesh of 9 x 9 masses and springs in Bullet's deformable world. Its face is pink and its underside yellow.
    The pickers are spheres. They are darker while they hold something. The distance of a picker from its shadow shows its
    height.

    ## Action Space

    `Box(-1, 1, (8,), float32)`, for one control step of 0.08 s:

    | Num | Action | Meaning |
    |-----|--------|---------|
    | 0, 1, 2 | move picker 0 along x, y, z | 0.08 m in one step |
    | 3 | pick | above 0: hold, or grasp the nearest free node within 6.1 cm of the centre; otherwise: release |
    | 4, 5, 6 | move picker 1 along x, y, z | 0.08 m in one step |
    | 7 | pick | as 3 |

    The centres of the pickers stay within x, y = -0.45 to 0.45 m and z = 0.05 to 0.4 m. Two pickers that hold the cloth
    cannot move farther apart than 1.1 times the distance of the held nodes in the flat cloth.

    ## Observation Space

    `obs_type="pixels"`: an RGB image. `obs_type="state"`: `Box(-10, 10, (32,), float32)`:

    | Num | Observation | Unit |
    |-----|-------------|------|
    | 0 to 5 | x, y, z of the two corners of the edge to carry | m |
    | 6 to 11 | x, y, z of the opposite corners, where those belong, in the same order | m |
    | 12 to 17 | x, y, z of picker 0, then of picker 1 | m |
    | 18, 19 | whether picker 0 and picker 1 hold the cloth | 0 or 1 |
    | 20 to 25 | x, y, z of the corner to carry that is closer to each picker at the start, relative to that picker | 0.08 m |
    | 26 to 31 | x, y, z of the opposite corners relative to the corners to carry | 0.08 m |

    Elements are clipped to the bounds, elements 20 to 31 therefore at 0.8 m.

    ## Rewards

    Each step: -(d + 1.2 f), where d is the mean distance between a node of the carried half and its mirror image in the
    other half, and f is the mean distance of the other half's nodes from their positions at reset, both in m. The middle
    row of nodes belongs to neither half.

    | `info` key | Meaning |
    |------------|---------|
    | `performance` | the reward |
    | `normalized_performance` | 1 - performance / initial |
    | `is_success` | `normalized_performance` is at least 0.9 |
    | `monotone` | -d, m |

    ## Starting State

    The cloth is flat and centred at the origin. The pickers are 10 cm above the floor, 10 cm to either side of the middle
    of the edge to carry. Variations differ in both side lengths of the cloth (0.38 to 0.54 m) and in its orientation (-45
    to 45 degrees).

    ## Episode End

    Truncation after 100 steps (8 s). There is no termination. If the simulation fails (an edge is longer than 4 times
    its rest length), the episode is truncated with `info["sim_error"]`, and the next one starts in a new world.

    ## Arguments

    See `SoftbodyEnv`, and

    * `keep_hold` (default `False`): pickers grasp the cloth when they reach it and never release it, regardless of actions
      3 and 7. Only the motion of the pickers remains to be learned. The task can be solved without releasing.

    ## Differences from SoftGym

    * The cloth has 81 nodes instead of 3600 to 14161, and sides of 0.38 to 0.54 m instead of 0.37 to 0.74 m. All of it is in
      the image and within reach of the pickers, whose box is smaller and centred on the cloth. The camera is slightly
      farther away.
    * Layers of the cloth do not collide with each other, so that they interpenetrate.
    * Pickers do not push the cloth and cannot tear it. SoftGym has a guard against tearing, which is switched off.
    * The state also contains which pickers hold something, where the corners are relative to the pickers, and how far the
      corners are from their goals, the latter two in units of a picker's largest move.
    * The cloth has no stripe of the other colour, and only the pickers cast shadows.

    ## Version History

    * v0: initial version
    """

    scenes: ClassVar[str] = "FoldClothEnv"
    expert: ClassVar[str | None] = "softbody_envs.experts.fold_cloth:FoldClothExpert"
    camera: ClassVar[Camera] = Camera(position=(0.0, -0.92, 0.95), target=(0.0, 0.0, 0.03))
    state_names: ClassVar[tuple[str, ...]] = (
        *(f"corner {corner} {axis}" for corner in range(4) for axis in "xyz"),
        *(f"picker {picker} {axis}" for picker in range(2) for axis in "xyz"),
        *(f"picker {picker} holds" for picker in range(2)),
        *(f"corner {corner} from picker {corner} {axis}" for corner in range(2) for axis in "xyz"),
        *(f"corner {corner + 2} from corner {corner} {axis}" for corner in range(2) for axis in "xyz"),
    )
    best_performance: ClassVar[float] = 0.0
    success_threshold: ClassVar[float] = 0.9
    steps_per_control: ClassVar[int] = STEPS_PER_CONTROL
    deformable: ClassVar[bool] = True

    #: Lowest and highest corner of the box that the centres of the pickers stay in, m.
    workspace: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = ((-0.45, -0.45, PICKER_RADIUS), (0.45, 0.45, 0.40))
    #: Largest move of a picker along each axis in one control step, m.
    picker_reach: ClassVar[float] = REACH
    #: Weight of the lower half's distance from its goal, relative to the distance between the halves.
    fixation_weight: ClassVar[float] = 1.2
    #: Number of axes, of x, y, z, in which these distances are measured.
    measured_axes: ClassVar[int] = 3

    def _build(self, world: World, rng: np.random.Generator) -> None:
        length, width = rng.uniform(*SIZES, 2)
        grid = flat_grid(length, width, yaw=rng.uniform(-np.pi / 4, np.pi / 4))
        x, y, _ = (grid[0, 0] + grid[0, -1]) / 2
        self._furnish(world, grid, [(x, y - PICKER_OFFSET, PICKER_HEIGHT), (x, y + PICKER_OFFSET, PICKER_HEIGHT)])
        for _ in range(SETTLE_STEPS):
            self.pickers.control(np.zeros(self.action_size))
        self._locate()
        self._place = self._kept()

    def _furnish(self, world: World, grid: np.ndarray, pickers: list[tuple[float, float, float]]) -> None:
        """Add a floor, a cloth at rest and two pickers to the world."""
        self._floor = world.add_box_floor()
        self.cloth = Cloth(world, grid)
        low, high = np.array(self.workspace)
        self.pickers = Pickers(
            world, self.cloth, np.array(pickers), low, high, PICKER_RADIUS, GRASP_RANGE, PICKER_MASS, self.picker_reach
        )

    def _locate(self) -> None:
        self._grid = self.cloth.grid()

    def _carried(self) -> np.ndarray:
        """Nodes of the half to carry, from its edge to the middle, m, ``(N_HALF, N_SIDE, 3)``."""
        return self._grid[:N_HALF]

    def _kept(self) -> np.ndarray:
        """Mirror images of these nodes in the other half, m, ``(N_HALF, N_SIDE, 3)``."""
        return self._grid[: -N_HALF - 1 : -1]

    def _measure(self) -> np.ndarray:
        corners = self._grid[[0, 0, -1, -1], [0, -1, 0, -1]]
        holds = [node is not None for node in self.pickers.held]
        pickers = self.pickers.positions
        ways = np.concatenate([corners[:2] - pickers, corners[2:] - corners[:2]]) / REACH
        return np.concatenate([corners.ravel(), pickers.ravel(), holds, ways.ravel()])

    def performance(self) -> float:
        """Minus the mean distance between the halves and the weighted mean distance of the lower half from its goal, m."""
        axes = self.measured_axes
        apart = _mean_distance(self._carried()[..., :axes], self._kept()[..., :axes])
        moved = _mean_distance(self._kept()[..., :axes], self._place[..., :axes])
        return -(apart + self.fixation_weight * moved)

    def monotone(self) -> float:
        """Minus the mean distance between the halves, m."""
        return -_mean_distance(self._carried(), self._kept())

    def fault(self) -> str | None:
        """Describe how the cloth has exploded, or return ``None``."""
        return self.cloth.fault()

    def _image(self, size: int) -> np.ndarray:
        frame, depth = self.renderer.render(self.world, self.camera, size)
        spheres = self.pickers.positions, PICKER_RADIUS
        paint_shadows(frame, depth, self.camera, self._floor, *spheres)
        paint_sheet(frame, depth, self.camera, self._grid, FACE, UNDERSIDE, *spheres)
        return frame


def _mean_distance(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.linalg.norm(first - second, axis=-1).mean())

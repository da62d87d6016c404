"""FoldCloth: fold a cloth in half with two pickers."""

from typing import ClassVar

import numpy as np

from softbody_envs.painting import paint_shadows, paint_sheet
from softbody_envs.rendering import Camera
from softbody_envs.sim.cloth import N_SIDE, STEPS_PER_CONTROL, Cloth, flat_grid
from softbody_envs.sim.pickers import REACH, Pickers
from softbody_envs.sim.world import World
from softbody_envs.tasks.picker_env import PickerEnv

#: Radius of the pickers, m, and how far from their centres a node may be to be taken: radius, threshold and radius of a
#: particle of SoftGym's.
PICKER_RADIUS = 0.05
GRASP_RANGE = PICKER_RADIUS + 0.005 + 0.00625
#: kg: a cloth does not hold them back.
PICKER_MASS = 100.0
#: The pickers start at this height, m, and this far from the middle of the edge to carry.
PICKER_HEIGHT = 0.10
PICKER_OFFSET = 0.10
#: Range of both sides of the cloth, m.
SIZES = (0.38, 0.54)
#: Control steps in which the cloth comes to rest before an episode.
SETTLE_STEPS = 2
#: Rows of nodes in each half of the cloth; the middle row belongs to neither.
N_HALF = N_SIDE // 2
FACE = (0.86, 0.27, 0.55)
UNDERSIDE = (0.98, 0.80, 0.30)


class FoldClothEnv(PickerEnv):
    """
    ## Description

    A cloth lies flat on the floor. Two pickers start above one of its edges. Take that edge by its corners, carry it over
    the cloth and lay it on the edge opposite, so that one half lies on the other and the other has not moved.

    The cloth is a mesh of 9 x 9 masses and springs in Bullet's deformable world. Its face is pink, its underside yellow.
    A picker is a sphere, dark while it holds something; the farther its shadow is from it the higher it is.

    ## Action Space

    `Box(-1, 1, (8,), float32)`, for one control step of 0.08 s:

    | Num | Action | Meaning |
    |-----|--------|---------|
    | 0, 1, 2 | move picker 0 along x, y, z | 0.08 m in one step |
    | 3 | pick | above 0: hold, or take the nearest free node within 6.1 cm of the centre; otherwise: let go |
    | 4, 5, 6 | move picker 1 along x, y, z | 0.08 m in one step |
    | 7 | pick | as 3 |

    The centres of the pickers stay within x, y = -0.45 to 0.45 m and z = 0.05 to 0.4 m. Two pickers that hold the cloth
    cannot be sent further apart than 1.1 times the distance of what they hold in the flat cloth. With `keep_hold=True` both
    hold all the time, whatever elements 3 and 7 say.

    ## Observation Space

    `obs_type="pixels"`: an RGB image. `obs_type="state"`: `Box(-10, 10, (32,), float32)`:

    | Num | Observation | Unit |
    |-----|-------------|------|
    | 0 to 5 | x, y, z of the two corners of the edge to carry | m |
    | 6 to 11 | x, y, z of the corners where those belong, in the same order | m |
    | 12 to 17 | x, y, z of picker 0, then of picker 1 | m |
    | 18, 19 | whether picker 0, picker 1 holds the cloth | 0 or 1 |
    | 20 to 25 | x, y, z of the corner of the edge to carry that each picker starts nearer to, seen from that picker | 0.08 m |
    | 26 to 31 | x, y, z of the corners where those belong, seen from them | 0.08 m |

    Elements are clipped at their bounds: what is farther than 0.8 m, elements 20 to 31 do not tell.

    ## Rewards

    Each step: -(d + 1.2 f). d is the mean distance between a node of the carried half and its mirror image in the other
    half, f the mean distance of the other half's nodes from where they were at reset, both in m. The middle row of nodes
    counts in neither.

    `performance` is this reward; `normalized_performance` = 1 - performance / initial performance; `is_success` from 0.9
    on; `monotone` is -d.

    ## Starting State

    The cloth flat, its middle at the origin, the pickers 10 cm above the floor, 10 cm to either side of the middle of the
    edge to carry. A variation draws both sides of the cloth (0.38 to 0.54 m) and its orientation (up to 45 degrees either
    way).

    ## Episode End

    Truncation after 100 steps (8 s). There is no termination. Should the simulation fail (an edge of more than 4 times
    its length), the episode is truncated with `info["sim_error"]`, and the next one starts in a new world.

    ## Arguments

    See `SoftbodyEnv`, and

    * `keep_hold` (default `False`): the pickers take the cloth when they come near it and never let go; what is left to
      decide is where they go. The cloth can be folded so.

    ## Differences from SoftGym

    * 81 nodes instead of 3600 to 14161, and sides of 0.38 to 0.54 m instead of 0.37 to 0.74 m: the whole cloth is in
      the image and within reach of the pickers, whose box is smaller and about the cloth's middle. The camera stands a
      little further off.
    * Layers do not collide with each other: they lie in each other, and a perfect fold scores 1 but for what moved.
    * Pickers do not push the cloth, and they cannot tear it apart (SoftGym has a guard against that, switched off).
    * The state also says which picker holds something, where its corner is from it, and how far the corner has to go, both
      in units of what a picker moves in one step.
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
    #: Farthest that a picker moves along each axis in one control step, m.
    picker_reach: ClassVar[float] = REACH
    #: Weight of how far the lower half is from its place against how far apart the halves are.
    fixation_weight: ClassVar[float] = 1.2
    #: How many of x, y, z these distances have.
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
        """Put a floor, a cloth at rest and two pickers into the world."""
        self._floor = world.add_box_floor()
        self.cloth = Cloth(world, grid)
        low, high = np.array(self.workspace)
        self.pickers = Pickers(
            world, self.cloth, np.array(pickers), low, high, PICKER_RADIUS, GRASP_RANGE, PICKER_MASS, self.picker_reach
        )

    def _locate(self) -> None:
        self._grid = self.cloth.grid()

    def _carried(self) -> np.ndarray:
        """Nodes of the half to lay on the other, from its edge to the middle, m, ``(N_HALF, N_SIDE, 3)``."""
        return self._grid[:N_HALF]

    def _kept(self) -> np.ndarray:
        """The nodes of the other half that they belong on, m, ``(N_HALF, N_SIDE, 3)``."""
        return self._grid[: -N_HALF - 1 : -1]

    def _measure(self) -> np.ndarray:
        corners = self._grid[[0, 0, -1, -1], [0, -1, 0, -1]]
        holds = [node is not None for node in self.pickers.held]
        pickers = self.pickers.positions
        ways = np.concatenate([corners[:2] - pickers, corners[2:] - corners[:2]]) / REACH
        return np.concatenate([corners.ravel(), pickers.ravel(), holds, ways.ravel()])

    def performance(self) -> float:
        """Minus the mean distance between the halves, and minus that of the lower half from its place, weighted, m."""
        axes = self.measured_axes
        apart = _mean_distance(self._carried()[..., :axes], self._kept()[..., :axes])
        moved = _mean_distance(self._kept()[..., :axes], self._place[..., :axes])
        return -(apart + self.fixation_weight * moved)

    def monotone(self) -> float:
        """Minus the mean distance between the halves, m."""
        return -_mean_distance(self._carried(), self._kept())

    def fault(self) -> str | None:
        """An explosion of the cloth."""
        return self.cloth.fault()

    def _image(self, size: int) -> np.ndarray:
        frame, depth = self.renderer.render(self.world, self.camera, size)
        spheres = self.pickers.positions, PICKER_RADIUS
        paint_shadows(frame, depth, self.camera, self._floor, *spheres)
        paint_sheet(frame, depth, self.camera, self._grid, FACE, UNDERSIDE, *spheres)
        return frame


def _mean_distance(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.linalg.norm(first - second, axis=-1).mean())

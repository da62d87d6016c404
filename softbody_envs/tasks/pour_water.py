"""PourWater: pour the water of one cup into another."""

from typing import ClassVar

import numpy as np

from softbody_envs.env import SoftbodyEnv
from softbody_envs.rendering import Camera
from softbody_envs.sim.cups import WALL, Cup, CupSize, corners, overlap
from softbody_envs.sim.water import DIAMETER, Water, lattice
from softbody_envs.sim.world import World

#: Largest change of the pose in one control step: x (m), z (m), tilt (rad).
REACH = np.array([0.08, 0.08, 0.12])
#: Smallest distance between cup and target, m: a particle between them is not squeezed through a wall.
MARGIN = DIAMETER
#: Depth of the sink for spilled water below the cups, m: no cup can press a particle into the floor.
SINK_DEPTH = 0.10
#: Control steps before an episode in which the water comes to rest.
SETTLE_STEPS = 8


class PourWaterEnv(SoftbodyEnv):
    """
    ## Description

    A cup of water stands beside a higher cup, the target. Lift the cup, bring its rim over the target, and tilt it until
    all the water is in the target.

    The water consists of 40 to 80 frictionless spheres of 2 cm radius. The front walls of both cups exist but are not
    drawn.

    ## Action Space

    `Box(-1, 1, (3,), float32)`: a velocity, constant during a control step of 0.08 s.

    | Num | Action | Largest change in one step |
    |-----|--------|----------------------------|
    | 0 | move along x, toward the target | 0.08 m |
    | 1 | move up | 0.08 m |
    | 2 | tilt toward the target | 0.12 rad |

    A control step consists of ten equal moves. A move is not executed at all if a corner of the cup would sink below its
    initial height, or if the cup would come closer to the target than one particle diameter (4 cm). Therefore the cup must
    be lifted before it can be tilted. The pose is limited to x from -0.3 m to 0.3 m beyond the target, height from 0 to
    0.75 m, and tilt from -pi to pi.

    ## Observation Space

    `obs_type="pixels"`: an RGB image. `obs_type="state"`: `Box(-10, 10, (13,), float32)`:

    | Num | Observation | Unit |
    |-----|-------------|------|
    | 0, 1 | x and height of the middle of the cup's underside | m |
    | 2 | tilt of the cup, positive toward the target | rad |
    | 3, 4, 5 | inner length (x), inner width (y) and height of the cup | m |
    | 6 | x of the target | m |
    | 7, 8, 9 | height, inner length (x) and inner width (y) of the target | m |
    | 10 | height of the highest particle | m |
    | 11 | fraction of the water in the target | 1 |
    | 12 | fraction of the water in the cup | 1 |

    ## Rewards

    Each step: the fraction of the particles that are in the target and not in the cup.

    | `info` key | Meaning |
    |------------|---------|
    | `performance` | the reward |
    | `normalized_performance` | (performance - initial) / (1 - initial) |
    | `is_success` | `normalized_performance` is at least 0.9 |
    | `monotone` | fraction of the water in the target |

    ## Starting State

    The water rests in the upright cup at x = 0. Variations differ in the cup's floor (4 to 6 by 3 to 4 particles), the
    number of particles (40 to 80), the height of the cup (1.15 to 1.6 times that of the water, plus 2 cm), the additional
    length, width and height of the target (up to 4, 4 and 10 cm), and the gap between the cups (8 to 22 cm).

    ## Episode End

    Truncation after 100 steps (8 s). There is no termination.

    ## Arguments

    See `SoftbodyEnv`.

    ## Differences from SoftGym

    * The water consists of 40 to 80 spheres instead of some thousand FleX particles. It is coarse and leaves a tilted cup
      in surges.
    * The cup keeps one particle diameter from the target, and spilled water falls into a sink 10 cm below: no particle is
      pressed through a wall. In SoftGym only contact is prevented, and spilled water stays on the table.
    * The pose is limited, so that the cup stays in the image.
    * Element 6 of the state is the position of the target. In SoftGym the position of the cup is added to it.
    * Water in a tilted cup is counted in the frame of the cup. SoftGym uses an upright box.
    * The cups never overlap at the start. In SoftGym they do in 0.7 % of the variations.

    ## Version History

    * v0: initial version
    """

    scenes: ClassVar[str] = "PourWaterEnv"
    expert: ClassVar[str | None] = "softbody_envs.experts.pour_water:PourWaterExpert"
    camera: ClassVar[Camera] = Camera(position=(0.25, -1.32, 0.86), target=(0.25, 0.0, 0.31))
    action_size: ClassVar[int] = 3
    state_names: ClassVar[tuple[str, ...]] = (
        "cup x",
        "cup z",
        "cup tilt",
        "cup inner length",
        "cup inner width",
        "cup height",
        "target x",
        "target height",
        "target inner length",
        "target inner width",
        "highest water",
        "fraction in target",
        "fraction in cup",
    )
    best_performance: ClassVar[float] = 1.0
    success_threshold: ClassVar[float] = 0.9
    steps_per_control: ClassVar[int] = 10

    def _build(self, world: World, rng: np.random.Generator) -> None:
        columns, rows = rng.integers(4, 7), rng.integers(3, 5)
        n = int(rng.integers(40, 81))
        size = CupSize(
            length=columns * DIAMETER + rng.uniform(0.01, 0.03),
            width=rows * DIAMETER + rng.uniform(0.01, 0.03),
            height=np.ceil(n / (columns * rows)) * DIAMETER * rng.uniform(1.15, 1.6) + 0.02,
        )
        target = CupSize(
            length=size.length + rng.uniform(0.0, 0.04),
            width=size.width + rng.uniform(0.0, 0.04),
            height=size.height + rng.uniform(0.0, 0.10),
        )
        gap = rng.uniform(0.08, 0.22)

        world.client.setPhysicsEngineParameter(numSolverIterations=10, minimumSolverIslandSize=1024)
        world.add_floor(-SINK_DEPTH)
        self.cup = Cup(world, size, x=0.0, color=(0.93, 0.80, 0.55, 1.0))
        self.target = Cup(
            world,
            target,
            x=(size.outer_length + target.outer_length) / 2 + gap,
            color=(0.75, 0.75, 0.78, 1.0),
            foot=SINK_DEPTH,
        )
        self.water = Water(world, lattice(n, size.length, size.width, WALL, rng))
        half, top = target.outer_length / 2 + MARGIN, target.outer_height + MARGIN
        self._forbidden = np.array([(-half, -SINK_DEPTH), (half, -SINK_DEPTH), (half, top), (-half, top)]) + (self.target.x, 0)
        self._low = np.array([-0.3, 0.0, -np.pi])
        self._high = np.array([self.target.x + 0.3, 0.75, np.pi])
        for _ in range(SETTLE_STEPS * self.steps_per_control):
            world.step()
        self._locate()

    def _control(self, action: np.ndarray) -> None:
        pose = np.array([self.cup.x, self.cup.z, self.cup.angle])
        part = np.arange(1, self.steps_per_control + 1)[:, None] / self.steps_per_control
        way = np.clip(pose + part * action * REACH, self._low, self._high)
        # Once a move is refused, all later moves of the step are.
        for there, allowed in zip(way, np.logical_and.accumulate(self._allowed(way)), strict=True):
            pose = there if allowed else pose
            self.cup.move(*pose)
            self.world.step()
        self._locate()

    def _allowed(self, poses: np.ndarray) -> np.ndarray:
        """
        Test which poses keep the cup above the table and away from the target. As in SoftGym, a move to any other pose is
        refused entirely.

        :param poses: x and z of the middle of the underside, m, and tilt, rad, ``(..., 3)``
        :return: bool ``(...)``
        """
        outlines = corners(self.cup.size, *np.moveaxis(poses, -1, 0))
        return (outlines[..., 1].min(axis=-1) >= -1e-9) & ~overlap(outlines, self._forbidden)

    def _locate(self) -> None:
        """Count the particles in each cup, once per control step."""
        positions = self.water.positions()
        in_cup = self.cup.contains(positions)
        self._highest = positions[:, 2].max()
        self.n_in_cup = int(in_cup.sum())
        self.n_in_target = int((self.target.contains(positions) & ~in_cup).sum())
        self.n_spilled = len(self.water) - self.n_in_cup - self.n_in_target

    def _measure(self) -> np.ndarray:
        cup, target, n = self.cup, self.target, len(self.water)
        return np.array(
            [
                cup.x,
                cup.z,
                cup.angle,
                cup.size.length,
                cup.size.width,
                cup.size.height,
                target.x,
                target.size.height,
                target.size.length,
                target.size.width,
                self._highest,
                self.n_in_target / n,
                self.n_in_cup / n,
            ]
        )

    def performance(self) -> float:
        """Fraction of the water in the target and not in the cup."""
        return self.n_in_target / len(self.water)

    def monotone(self) -> float:
        """Fraction of the water in the target."""
        return self.n_in_target / len(self.water)

"""The maze tasks of mujoco-maze (https://github.com/kngwyu/mujoco-maze) on today's MuJoCo.

An ant, a point or a swimmer has to find a goal in a maze of square cells, in some mazes by pushing
blocks out of its way. The original package needs gym and mujoco-py, which are no longer maintained.
This file needs neither. It has the tasks of version 1, with a sparse reward at the goal.

    gymnasium.make("AntUMaze-v1")       # after `import study.environments`, which registers the ids
    MazeEnv(robot="ant", maze="UMaze")  # the same, without the limit of 1000 steps

The robots are the XML models in Gymnasium; `build_model` changes what differs in mujoco-maze.
"""

import math
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv

GOAL_RADIUS = 0.6  # m, in the plane
STEP_REWARD = -0.0001  # a step that does not reach the goal
INNER_REWARD = 0.01  # weight of the reward for moving
CONTROL_COST = 1e-4  # weight of sum(action^2) in the reward for moving
POINT_RADIUS = 0.4  # m, of the point when it is reflected at walls; its body has 0.5
RESTITUTION = 0.8  # the part of the remaining way that the point keeps when a wall reflects it
POINT_MAX_VELOCITY = 10.0


class Maze(NamedTuple):
    grid: str  # '#' wall, '.' free, 'R' robot, 'M' movable block; columns along +x, rows along +y
    goal: tuple[float, float]  # (x, y) in cells, seen from the robot's cell
    scale: dict[str, float]  # side of a cell in m, for each robot that the task has


MAZES = {
    "UMaze": Maze(
        """
        #####
        #R..#
        ###.#
        #...#
        #####
        """,
        goal=(0, 2),
        scale={"ant": 8, "point": 4, "swimmer": 4},
    ),
    "4Rooms": Maze(
        """
        #########
        #...#...#
        #.......#
        #...#...#
        ##.###.##
        #...#...#
        #.......#
        #R..#...#
        #########
        """,
        goal=(6, -6),
        scale={"ant": 4, "point": 4, "swimmer": 4},
    ),
    "Push": Maze(
        """
        #####
        #.R##
        #.M.#
        ##.##
        #####
        """,
        goal=(0, 2.375),
        scale={"ant": 8, "point": 4},
    ),
    "PushMaze": Maze(
        """
        #######
        #..RM.#
        ####.##
        #.M.M##
        ##.#.##
        #######
        """,
        goal=(3, 0),  # inside the outer wall, as in the original: out of reach
        scale={"ant": 2, "point": 6},
    ),
}


# Seconds per step of the physics, and its steps per step of the environment
TIMESTEPS = {"ant": (0.02, 5), "point": (0.02, 1), "swimmer": (0.01, 4)}


def read_grid(grid, scale):
    """The cells of a text grid as (character, x, y), in reading order.

    (x, y) is the cell's center in m; the robot's is (0, 0).
    """
    rows = grid.split()
    row0, col0 = next((i, row.index("R")) for i, row in enumerate(rows) if "R" in row)
    cells = [(i, j, c) for i, row in enumerate(rows) for j, c in enumerate(row)]
    return [(c, (j - col0) * scale, (i - row0) * scale) for i, j, c in cells]


def build_model(robot, cells, scale, goal, old_capsule_inertia=True):
    """The robot's model from Gymnasium, changed to mujoco-maze's, with the maze around it.

    Returns a mujoco.MjModel.
    """
    assets = Path(gym.__file__).parent / "envs/mujoco/assets"
    spec = mujoco.MjSpec.from_file(str(assets / f"{robot}.xml"))
    spec.option.timestep, _ = TIMESTEPS[robot]
    # The midphase of collision detection is newer than the study's MuJoCo 2.1.0. Without it the
    # ant's steps are the same in 10 % less time. The point's contacts come in another order: with
    # it 1.2 % of the point's steps at walls end elsewhere, by up to 2 cm and 2 m/s.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    if robot == "ant":
        for actuator in spec.actuators:
            actuator.gear[0] = 1
            actuator.ctrlrange = [-30, 30]
    if robot == "swimmer":  # it swims through the walls, in the original too
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    if robot == "point":
        # Its sphere just touches the floor, at distance 0, and slides without friction in MuJoCo 2.
        # In MuJoCo 3 rounding makes it -6e-17 at 18 % of the headings: contact, and friction.
        spec.geom("floor").contype = spec.geom("floor").conaffinity = 0
        # A box reaches half as far into a box in MuJoCo 2. Half the stiffness at the same damping
        # makes up for it: a damping ratio of 2**0.5, the mean of this one and the walls', 1.
        spec.geom("pointarrow").solref[1] = 2 * 2**0.5 - 1

    has_blocks = any(c == "M" for c, _, _ in cells)
    solimp = [0.995, 0.995, 0.01] if has_blocks else [0.8, 0.8, 0.01] if robot == "ant" else None
    # The default is for the geoms that add_maze adds; those of the XML are made already
    for geom in [spec.default.geom, *spec.geoms]:
        if geom.name in ("pointbody", "pointarrow"):
            geom.solimp[:3] = [0.9, 0.99, 0.001]
        elif solimp:
            geom.solimp[:3] = solimp
        if geom.name != "floor":
            geom.material, geom.rgba = "", [0.95, 0.45, 0.05, 1]
    floor, tiles = spec.material("MatPlane"), spec.texture("texplane")
    floor.reflectance, tiles.rgb1, tiles.rgb2 = 0, [0.80, 0.82, 0.85], [0.70, 0.72, 0.76]

    add_maze(spec, cells, scale, goal)
    model = spec.compile()
    if old_capsule_inertia:
        set_old_capsule_inertia(model)
    return model


def add_maze(spec, cells, scale, goal):
    """Adds walls, blocks and a picture of the goal to the MjSpec of a robot."""
    height = scale / 2
    size = [scale / 2, scale / 2, height / 2]
    box = dict(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, contype=1, conaffinity=1)
    for i, (c, x, y) in enumerate(cells):
        if c == "#":
            place = {"name": f"wall_{i}", "pos": [x, y, height / 2]}
            spec.worldbody.add_geom(**box, **place, rgba=[0.35, 0.4, 0.5, 1])
        elif c == "M":
            body = spec.worldbody.add_body(name=f"block_{i}", pos=[x, y, height / 2])
            body.add_geom(**box, name=f"block_{i}", mass=0.0002, rgba=[0.75, 0.15, 0.2, 1])
            slide = dict(type=mujoco.mjtJoint.mjJNT_SLIDE, margin=0.01, limited=0, armature=0)
            for name, axis in (("x", [1, 0, 0]), ("y", [0, 1, 0])):
                body.add_joint(**slide, damping=[0, 0, 0], name=f"block_{i}_{name}", axis=axis)
    # A post as wide as the goal. It is higher than the walls, as some goals are inside of one.
    post = dict(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[GOAL_RADIUS, 0.7 * height, 0])
    spec.worldbody.add_site(**post, pos=[*goal, 0.7 * height], rgba=[0.1, 0.7, 0.1, 1])


def set_old_capsule_inertia(model):
    """Gives each body that is one capsule the mass and inertia of MuJoCo before 2.1.2, in place.

    A capsule of radius r and cylinder length L was taken for a cylinder of height h = L + r. The
    swimmer's fluid drag depends on it, and so do its returns: the published ones need this.
    """
    for body in range(1, model.nbody):
        first, count = model.body_geomadr[body], model.body_geomnum[body]
        if count == 1 and model.geom_type[first] == mujoco.mjtGeom.mjGEOM_CAPSULE:
            r, half_length, _ = model.geom_size[first]
            h = 2 * half_length + r
            # The exact volume is pi r^2 (L + 4 r / 3)
            model.body_mass[body] = mass = model.body_mass[body] * h / (h + r / 3)
            across, about = mass * (3 * r**2 + h**2) / 12, mass * r**2 / 2
            model.body_inertia[body] = across, across, about  # the capsule's axis is the third
    mujoco.mj_setConst(model, mujoco.MjData(model))


# --- The point's walls: it is moved by its coordinates, and its moves are reflected


def wall_faces(cells, scale):
    """The faces of the walls, which stand out by the point's radius.

    Returns tuples (axis, position on this axis, low and high end on the other axis). The original
    has no face between a wall and the first cell of a block. Its point can leave PushMaze there;
    this one cannot.
    """
    reach = scale / 2 + POINT_RADIUS
    free = {(x, y) for c, x, y in cells if c != "#"}
    faces = []
    for c, x, y in cells:
        for axis, dx, dy in ((1, 0, -1), (0, -1, 0), (1, 0, 1), (0, 1, 0)):
            if c == "#" and (x + dx * scale, y + dy * scale) in free:
                across, along = (y + dy * reach, x) if axis else (x + dx * reach, y)
                faces.append((axis, across, along - reach, along + reach))
    return faces


def first_crossing(faces, start, end):
    """The first face that the segment start-end crosses: (distance / length, face), or None."""
    crossed, delta = [], (end[0] - start[0], end[1] - start[1])
    for face in faces:
        axis, across, low, high = face
        a, b = start[axis] - across, end[axis] - across
        if a * b <= 0 and a != b:
            t = a / (a - b)
            if low <= start[1 - axis] + t * delta[1 - axis] <= high:
                crossed.append((t, face))
    return min(crossed, default=None, key=lambda hit: hit[0])


def reflect(faces, start, end):
    """Where a move from start to end, (x, y), arrives: at `end` if no wall is in the way."""
    hit = first_crossing(faces, start, end)
    if hit is None:
        return end
    t, (axis, across, _, _) = hit
    crossing = [s + t * (e - s) for s, e in zip(start, end, strict=True)]
    mirrored = list(end)
    mirrored[axis] = 2 * across - end[axis]
    arrival = tuple(c + RESTITUTION * (m - c) for c, m in zip(crossing, mirrored, strict=True))
    return start if first_crossing(faces, start, arrival) else arrival


class MazeEnv(MujocoEnv):
    """A robot that looks for a goal in a maze.

    Arguments:
        robot: "ant", "point" or "swimmer".
        maze: a key of `MAZES`.
        goal: (x, y) in m from the center of the robot's cell; default: the maze's own.
        old_capsule_inertia: masses and inertias as in MuJoCo before 2.1.2, with which the published
            results were made.
        render_mode: None or "rgb_array": the whole maze from above, (480, 480, 3) uint8.

    Action, clipped to its bounds: joint torques in [-30, 30] N m (ant, 8) or [-1, 1] times 150 N m
    (swimmer, 2); for the point a step forward in [-1, 1] m and, before it, a turn in [-0.25, 0.25]
    rad.
    Observation: the robot's first three coordinates, the position (x, y, z) of each block, the
    robot's other coordinates, its velocities, 0.001 * step.
    Reward: 1 within 0.6 m of the goal, which terminates the episode, otherwise -0.0001; for ant and
    swimmer also 0.01 * (speed in m/s - 1e-4 * sum(action^2)).
    Info: `success`, whether the goal is reached.
    """

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, robot, maze, goal=None, old_capsule_inertia=True, render_mode=None):
        scale = MAZES[maze].scale[robot]
        self.robot = robot
        self.goal = tuple(goal) if goal is not None else tuple(scale * c for c in MAZES[maze].goal)
        self.cells = read_grid(MAZES[maze].grid, scale)
        self.faces = wall_faces(self.cells, scale)
        self.model = build_model(robot, self.cells, scale, self.goal, old_capsule_inertia)
        xy = np.array([(x, y) for _, x, y in self.cells])
        camera = {"lookat": np.array([*(xy.min(0) + xy.max(0)) / 2, 0]), "azimuth": 90}
        camera |= {"distance": 1.55 * np.ptp(xy, 0).max(), "elevation": -65}
        how = {"camera_id": -1, "default_camera_config": camera}  # -1: that of this configuration
        super().__init__(f"{robot}.xml", TIMESTEPS[robot][1], None, render_mode, **how)
        self.metadata = self.metadata | {"render_fps": round(1 / self.dt)}
        self.n_blocks = sum(c == "M" for c, _, _ in self.cells)
        # Of the robot. The coordinates of the blocks follow, two for each
        self.nq, self.nv = self.model.nq - 2 * self.n_blocks, self.model.nv - 2 * self.n_blocks
        obs_dim = self.nq + 3 * self.n_blocks + self.nv + 1
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (obs_dim,), np.float64)
        self._low, self._high = self.model.actuator_ctrlrange.T.copy()

    def _initialize_simulation(self):  # in place of MujocoEnv's, which reads the XML file as it is
        return self.model, mujoco.MjData(self.model)

    def reset_model(self):
        """Draws the robot's coordinates and velocities near the model's."""
        self._steps = 0
        self.data.qpos[: self.nq] += self.np_random.uniform(-0.1, 0.1, self.nq)
        if self.robot == "swimmer":
            self.data.qvel[:] = self.np_random.uniform(-0.1, 0.1, self.nv)
        else:
            self.data.qvel[: self.nv] = 0.1 * self.np_random.standard_normal(self.nv)
        mujoco.mj_forward(self.model, self.data)
        return self._observation()

    def step(self, action):
        """One step of `dt` seconds with an action of shape (action_dim,)."""
        action = np.minimum(np.maximum(action, self._low), self._high)
        self._steps += 1
        start, position = self.data.qpos[:2].tolist(), self.data.qpos[:2]  # a view
        if self.robot == "point":
            self._move_point(*action.tolist())
            reward = 0.0
        else:
            self.data.ctrl[:] = action
            mujoco.mj_step(self.model, self.data, self.frame_skip)
            speed = math.dist(position, start) / self.dt
            reward = INNER_REWARD * (speed - CONTROL_COST * float(action @ action))
        reached = math.dist(position, self.goal) <= GOAL_RADIUS
        reward += 1.0 if reached else STEP_REWARD
        return self._observation(), reward, reached, False, {"success": reached}

    def _move_point(self, forward, turn):
        """Turns the point and moves it forward, steps the physics, then reflects it at walls."""
        qpos, qvel = self.data.qpos, self.data.qvel
        x, y, heading = qpos[:3].tolist()
        heading += turn
        if abs(heading) > math.pi:
            heading -= math.copysign(2 * math.pi, heading)
        qpos[:3] = x + forward * math.cos(heading), y + forward * math.sin(heading), heading
        np.clip(qvel, -POINT_MAX_VELOCITY, POINT_MAX_VELOCITY, out=qvel)
        mujoco.mj_step(self.model, self.data)
        qpos[:2] = reflect(self.faces, (x, y), tuple(qpos[:2].tolist()))

    def _observation(self):
        qpos, nq, step = self.data.qpos, self.nq, [0.001 * self._steps]
        parts = [qpos[:nq], self.data.qvel[: self.nv], step]
        if self.n_blocks:
            # After mj_step the bodies are where the last stage of the integrator had them
            mujoco.mj_kinematics(self.model, self.data)
            parts[:1] = qpos[:3], self.data.xpos[-self.n_blocks :].reshape(-1), qpos[3:nq]
        return np.concatenate(parts)

    def render(self):
        """The maze from above, RGB (480, 480, 3) uint8, if `render_mode` is "rgb_array"."""
        mujoco.mj_kinematics(self.model, self.data)
        return super().render()

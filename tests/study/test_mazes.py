"""The mazes against steps of the original and figures worked out by hand from its rules."""

import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import study.environments  # noqa: F401  registers the ids
from study.mazes import reflect

#      id                 obs  action high     goal (x, y)  s/step  blocks' first (x, y)
TASKS = {
    "PointUMaze-v1": (7, [1, 0.25], (0, 8), 0.02, []),
    "Point4Rooms-v1": (7, [1, 0.25], (24, -24), 0.02, []),
    "PointPush-v1": (10, [1, 0.25], (0, 9.5), 0.02, [(0, 4)]),
    "PointPushMaze-v1": (16, [1, 0.25], (18, 0), 0.02, [(6, 0), (-6, 12), (6, 12)]),
    "AntUMaze-v1": (30, [30] * 8, (0, 16), 0.1, []),
    "Ant4Rooms-v1": (30, [30] * 8, (24, -24), 0.1, []),
    "AntPush-v1": (33, [30] * 8, (0, 19), 0.1, [(0, 8)]),
    "AntPushMaze-v1": (39, [30] * 8, (6, 0), 0.1, [(2, 0), (-2, 4), (2, 4)]),
    "SwimmerUMaze-v1": (11, [1, 1], (0, 8), 0.04, []),
    "Swimmer4Rooms-v1": (11, [1, 1], (24, -24), 0.04, []),
}
SIZES = {"Point": (3, 3), "Ant": (15, 14), "Swimmer": (5, 5)}  # nq, nv
QPOS0 = {"Point": [0] * 3, "Ant": [0, 0, 0.75, 1] + [0] * 11, "Swimmer": [0] * 5}
SIDES = {"AntUMaze-v1": 8, "AntPush-v1": 8, "AntPushMaze-v1": 2, "PointPushMaze-v1": 6}  # else 4


def make(env_id, **kwargs):
    return gym.make(env_id, **kwargs).unwrapped


def robot_of(env_id):
    return next(robot for robot in SIZES if env_id.startswith(robot))


def place(env, x, y, heading=None, **velocities):
    """Puts the robot at (x, y), upright, at rest but for these velocities (v0 of coordinate 0)."""
    env.reset(seed=0)
    mujoco.mj_resetData(env.model, env.data)
    env.data.qpos[:2] = x, y
    if heading is not None:  # of the point
        env.data.qpos[2] = heading
    for i, v in velocities.items():
        env.data.qvel[int(i[1:])] = v


def walls_of(model):
    """The walls' centers (n, 2), side and height in m, from the compiled model, not the grid."""
    walls = [i for i in range(model.ngeom) if model.geom(i).name.startswith("wall")]
    _, side, height = 2 * model.geom_size[walls[0]]
    return model.geom_pos[walls][:, :2], side, height


# Cells that are not walls, (x, y) counted from the robot's
ROOMS = [(x, y) for x in (0, 1, 2, 4, 5, 6) for y in (-6, -5, -4, -2, -1, 0)]
ROWS = [(x, y) for y, xs in ((0, range(-2, 3)), (2, range(-2, 2))) for x in xs]
FREE = {
    "UMaze": [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2)],
    "4Rooms": [*ROOMS, (3, -5), (3, -1), (1, -3), (5, -3)],  # and the doors between them
    "Push": [(-1, 0), (0, 0), (-1, 1), (0, 1), (1, 1), (0, 2)],
    "PushMaze": [*ROWS, (1, 1), (-1, 3), (1, 3)],
}


@pytest.mark.parametrize("env_id", TASKS)
def test_walls_stand_where_they_should(env_id):
    walls, side, height = walls_of(make(env_id).model)
    free = np.array(FREE[env_id.removeprefix(robot_of(env_id)).removesuffix("-v1")])
    (x0, y0), (x1, y1) = free.min(axis=0) - 1, free.max(axis=0) + 1
    assert len(walls) + len(free) == (x1 - x0 + 1) * (y1 - y0 + 1)
    cells = {(round(x), round(y)) for x, y in walls / side} | {(x, y) for x, y in free.tolist()}
    assert cells == {(x, y) for x in range(x0, x1 + 1) for y in range(y0, y1 + 1)}
    assert side == SIDES.get(env_id, 4) and height == side / 2


@pytest.mark.filterwarnings("ignore")  # it recommends other bounds than the original's
@pytest.mark.parametrize("env_id", TASKS)
def test_spaces_and_gymnasium_checks(env_id):
    obs_dim, high, goal, dt, _ = TASKS[env_id]
    env, spec = make(env_id), gym.spec(env_id)
    check_env(env, skip_render_check=True)
    assert (spec.max_episode_steps, spec.reward_threshold) == (1000, 0.9)
    assert env.action_space == gym.spaces.Box(-np.float32(high), np.float32(high))
    assert env.observation_space == gym.spaces.Box(-np.inf, np.inf, (obs_dim,), np.float64)
    assert env.goal == goal and env.dt == pytest.approx(dt)
    assert env.metadata["render_fps"] == round(1 / dt)


# --- Reset, observation, reward


@pytest.mark.parametrize("env_id", TASKS)
def test_reset_ranges(env_id):
    robot, blocks = robot_of(env_id), TASKS[env_id][4]
    nq, nv = SIZES[robot]
    env, n_block = make(env_id), 3 * len(blocks)
    obs = np.array([env.reset(seed=i)[0] for i in range(300)])
    coordinates = np.delete(obs[:, : nq + n_block], np.s_[3 : 3 + n_block], axis=1) - QPOS0[robot]
    largest = abs(coordinates).max(axis=0)
    assert (largest <= 0.1).all() and (largest > 0.095).all()
    np.testing.assert_allclose(coordinates.std(axis=0), 0.2 / math.sqrt(12), rtol=0.15)
    velocities = obs[:, nq + n_block : -1]
    assert velocities.shape == (300, nv) and (obs[:, -1] == 0).all()
    std = 0.2 / math.sqrt(12) if robot == "Swimmer" else 0.1
    np.testing.assert_allclose(velocities.std(axis=0), std, rtol=0.2)
    assert (abs(velocities).max() <= 0.1) == (robot == "Swimmer")  # uniform, the others' Gaussian
    home = np.ravel([(x, y, SIDES.get(env_id, 4) / 4) for x, y in blocks])
    np.testing.assert_array_equal(obs[:, 3 : 3 + n_block], np.tile(home, (300, 1)))
    assert not env.data.qvel[nv:].any()


@pytest.mark.parametrize("env_id", TASKS)
def test_observation_layout_and_reward(env_id):
    _, high, _, dt, blocks = TASKS[env_id]
    nq, nv = SIZES[robot_of(env_id)]
    env = make(env_id)
    before, _ = env.reset(seed=1)
    q, v, rng = env.data.qpos, env.data.qvel, np.random.default_rng(1)
    for step in range(1, 20):
        action = rng.uniform(-1, 1, len(high)) * high
        obs, reward, terminated, truncated, info = env.step(action)
        moved = q[nq:].reshape(-1, 2) + np.reshape(blocks, (-1, 2))
        blocks_xyz = np.ravel([(x, y, SIDES.get(env_id, 4) / 4) for x, y in moved])
        expected = [*q[:3], *blocks_xyz, *q[3:nq], *v[:nv], 0.001 * step]
        np.testing.assert_allclose(obs, expected, atol=1e-12)
        speed, cost = math.dist(obs[:2], before[:2]) / dt, 1e-4 * sum(a * a for a in action)
        inner = 0 if env_id.startswith("Point") else speed - cost
        assert reward == pytest.approx(-0.0001 + 0.01 * inner, rel=1e-9)
        assert (terminated, truncated, info["success"]) == (False, False, False)
        before = obs


@pytest.mark.parametrize("env_id", [env_id for env_id in TASKS if "PushMaze" not in env_id])
def test_goal_ends_the_episode(env_id):
    _, high, goal, _, _ = TASKS[env_id]
    env = make(env_id)
    slack = 1e-6 if env_id.startswith("Point") else 0.05  # what the robot moves in the step
    for distance, reached in ((0.6 - slack, True), (0.6 + slack, False)):
        place(env, goal[0] - 0.6 * distance, goal[1] - 0.8 * distance)
        obs, reward, terminated, truncated, info = env.step(np.zeros(len(high)))
        assert (math.dist(obs[:2], goal) <= 0.6) == reached == terminated == info["success"]
        assert not truncated and reward == pytest.approx(1 if reached else -0.0001, abs=0.01)
        if env_id.startswith("Point"):
            assert reward == (1 if reached else -0.0001)


def test_goal_of_pushmaze_is_in_the_wall_so_it_is_an_argument():
    for env_id in ("PointPushMaze-v1", "AntPushMaze-v1"):
        walls, side, _ = walls_of(make(env_id).model)
        assert (abs(walls - TASKS[env_id][2]).max(axis=1) < 1e-9).any()  # the center of a wall
        assert side / 2 > 0.6  # the whole disk that counts as the goal is inside the wall
    env = make("PointPushMaze-v1", goal=[-6, 0.0])
    place(env, -5.5, 0)
    assert env.step(np.zeros(2))[1:3] == (1.0, True)


# --- Robots


def test_model_parameters():
    """Those of the original's XML files."""
    ant, point, swimmer = (make(f"{robot}UMaze-v1").model for robot in ("Ant", "Point", "Swimmer"))
    assert (ant.opt.timestep, point.opt.timestep, swimmer.opt.timestep) == (0.02, 0.02, 0.01)
    assert all(m.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 for m in (ant, point, swimmer))
    midphase = mujoco.mjtDisableBit.mjDSBL_MIDPHASE  # which the study's MuJoCo did not have
    assert all(m.opt.disableflags & midphase for m in (ant, point, swimmer))
    assert (ant.actuator_gear[:, 0] == 1).all() and (swimmer.actuator_gear[:, 0] == 150).all()
    assert (ant.geom_solimp[:, :3] == [0.8, 0.8, 0.01]).all()
    assert (ant.geom_solref == [0.02, 1]).all()
    push = make("AntPush-v1").model
    assert (push.geom_solimp[:, :3] == [0.995, 0.995, 0.01]).all()
    for env_id, others in (
        ("PointUMaze-v1", [0.9, 0.95, 0.001]),
        ("PointPush-v1", [0.995, 0.995, 0.01]),
    ):
        model = make(env_id).model
        robot = model.geom_bodyid == model.body("torso").id
        assert robot.sum() == 2 and (model.geom_solimp[robot, :3] == [0.9, 0.99, 0.001]).all()
        assert (model.geom_solimp[~robot, :3] == others).all()
    assert push.body_mass[-1] == 0.0002 and push.geom_size[-1].tolist() == [4, 4, 2]
    assert (push.jnt_margin[-2:] == 0.01).all() and not push.jnt_limited[-2:].any()
    assert not push.dof_armature[-2:].any() and not push.dof_damping[-2:].any()


@pytest.mark.parametrize(
    "env_id, density, r, n_capsules",
    [("SwimmerUMaze-v1", 1000, 0.1, 3), ("AntPush-v1", 5, 0.08, 12)],
)
def test_inertia_of_capsules_is_that_of_cylinders(env_id, density, r, n_capsules):
    """Of the same radius, and longer by it."""
    model = make(env_id).model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    capsules = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE)
    assert len(capsules) == n_capsules
    for geom in capsules:
        body, length = model.geom_bodyid[geom], 2 * model.geom_size[geom, 1]
        assert np.isclose(length, [1, 0.2 * math.sqrt(2), 0.4 * math.sqrt(2)]).any()
        h = length + r
        mass = density * math.pi * r**2 * h
        about, across = mass * r**2 / 2, mass * (3 * r**2 + h**2) / 12
        assert model.body_mass[body] == pytest.approx(mass, rel=1e-9)
        axis = data.geom_xmat[geom].reshape(3, 3)[:, 2]  # a capsule lies along its own z
        frame = data.ximat[body].reshape(3, 3)
        tensor = frame @ np.diag(model.body_inertia[body]) @ frame.T
        expected = across * np.eye(3) + (about - across) * np.outer(axis, axis)
        np.testing.assert_allclose(tensor, expected, atol=1e-9 * across)
    total = model.body_mass.sum()
    assert model.body_subtreemass[0] == pytest.approx(total, rel=1e-9)  # mj_setConst ran
    assert make(env_id, old_capsule_inertia=False).model.body_mass.sum() > 1.01 * total


@pytest.mark.parametrize("robot", ["Ant", "Swimmer"])
def test_walls_stop_the_ant_but_not_the_swimmer(robot):
    env = make(f"{robot}4Rooms-v1")
    place(env, 0, 0)
    xs = []
    for _ in range(60):
        env.data.qvel[0] = -4  # m/s, towards a wall that begins at x = -2
        xs.append(env.step(np.zeros(env.model.nu))[0][0])
    if robot == "Ant":  # its torso, a ball of radius 0.25, touches the wall
        assert -1.85 < min(xs) < -1.7
    else:
        assert min(xs) < -6


# --- The point


def test_point_turns_first_then_moves_and_wraps_its_heading():
    env = make("PointUMaze-v1")
    place(env, 0, 0, heading=3.1)
    obs, heading = env.step([0.5, 0.2])[0], 3.1 + 0.2 - 2 * math.pi
    expected = [0.5 * math.cos(heading), 0.5 * math.sin(heading), heading]
    np.testing.assert_allclose(obs[:3], expected, atol=1e-9)
    place(env, 0, 0, heading=-3.1)
    assert env.step([0, -7])[0][2] == pytest.approx(-3.1 - 0.25 + 2 * math.pi)  # clipped to 0.25
    place(env, 0, 0, v0=100)  # velocities are clipped to 10 before a step of 0.02
    assert env.step([0, 0])[0][0] == pytest.approx(0.2)


# Start, end and arrival. In PointUMaze a cell is 4 wide. The robot's cell has faces at x = -1.6,
# y = -1.6 and y = 1.6 (walls at 2, less 0.4); the wall in the middle ends at x = 6 and y = 2, its
# faces are at x = 6.4 and y = 1.6. Of what is left of the move at the face, 0.8 goes back.
REFLECTIONS = [
    ((0, 0), (0.9, 0.3), (0.9, 0.3)),  # free
    ((-1, 0), (-2, 0), (-1.28, 0)),  # head-on; 0.4 is left at the face
    ((-1.2, 0), (-2, 0.5), (-1.28, 0.45)),  # oblique, at (-1.6, 0.25); 0.4 and 0.25 are left
    ((0, 1.2), (0.6, 2), (0.54, 1.28)),  # in y, at (0.3, 1.6); 0.3 and 0.4 are left
    # An outer corner, at (6.275, 1.6), before x = 6.4; 0.225 and 0.6 are left. And past it
    ((6.2, 1.4), (6.5, 2.2), (6.455, 1.12)),
    ((6.5, 1.4), (6.5, 2.4), (6.5, 2.4)),
    ((-1.3, -1.5), (-1.8, -1.55), (-1.44, -1.546)),  # inner corner, at (-1.6, -1.53)
    ((-1.5, -1.5), (-2, -1.8), (-1.5, -1.5)),  # reflected at x = -1.6, the rest crosses y = -1.6
    ((-1.6, 0), (-1.6, 0.5), (-1.6, 0.5)),  # along a face: free
    ((-1, 0), (-1.6, 0), (-1, 0)),  # onto it: reflected to where it arrived, again on a face
]


@pytest.mark.parametrize("start, end, arrival", REFLECTIONS)
def test_reflection_at_walls(start, end, arrival):
    env = make("PointUMaze-v1")
    np.testing.assert_allclose(reflect(env.faces, start, end), arrival, atol=1e-12)
    # Without contacts, which would push the body as well
    env.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    heading = math.atan2(end[1] - start[1], end[0] - start[0])
    place(env, *start, heading=heading)
    obs, *_ = env.step([math.dist(start, end), 0])
    np.testing.assert_allclose(obs[:3], [*arrival, heading], atol=1e-12)


# Steps of the original, mujoco-maze's last commit on MuJoCo 2.3.7, with random actions in 4 Rooms:
# (x, y, heading and their velocities, action, the same after it). Three without a contact, three
# whose arrow reaches into a wall.
STEPS_OF_THE_ORIGINAL = [
    ((24.544124704, -7.648206685, -2.404735152, -2.911415813, 0.034421268, -0.113542444),
     (-1, -0.25), (25.369704, -7.179667, -2.657006, -2.911426, 0.034416, -0.113542)),
    ((1.143611696, -5.723967427, 2.153337498, 0.168680069, 1.649482437, 0.297422143),
     (-1, 0.25), (1.886629, -6.363976, 2.409286, 0.168624, 1.649533, 0.297422)),
    ((5.004113479, -5.106884473, -1.694575674, -1.819045921, -2.346958283, -0.378096645),
     (1, -0.16259516), (4.685256, -6.113099, -1.864733, -1.819081, -2.347075, -0.378097)),
    ((5.373260648, 1.135419284, 0.853469721, 1.630943112, -3.420149248, 3.465677001),
     (0.829927104, -0.25), (6.086558, 1.535258, 0.663334, 1.439031, -3.628705, 2.699407)),
    ((-1.149734094, -18.15080019, -0.459999455, 1.60360509, -2.135812717, -3.562964414),
     (-0.7463501, -0.203841296), (-1.529404, -17.739098, -0.752373, 2.959801, -1.463242, -4.93539)),
    ((9.325972641, -3.071988897, 0.980455842, 1.377631812, -1.317789953, -4.424649255),
     (0.627708622, 0.25), (9.561634, -2.504346, 1.172567, 1.20968, -1.053599, -0.852637)),
]  # fmt: skip


@pytest.mark.parametrize("before, action, after", STEPS_OF_THE_ORIGINAL)
def test_point_moves_as_in_the_original(before, action, after):
    env = make("Point4Rooms-v1")
    env.reset(seed=0)
    env.data.qpos[:], env.data.qvel[:], env.data.qacc_warmstart[:] = before[:3], before[3:], 0
    np.testing.assert_allclose(env.step(action)[0][:6], after, atol=2e-5)


def test_point_slides_without_friction():
    """At any heading: rounding must not make a contact of its sphere and the floor."""
    env = make("Point4Rooms-v1")
    env.reset(seed=0)
    for heading in np.linspace(-3, 3, 200):
        env.data.qpos[:], env.data.qvel[:] = (0, 0, heading), (0.5, 0.5, 0)
        env.step([0, 0])
        np.testing.assert_allclose(env.data.qvel, [0.5, 0.5, 0], atol=1e-3)


# --- Blocks


def test_point_pushes_the_block():
    env = make("PointPush-v1")
    place(env, 0, 0, heading=math.pi / 2)
    obs = np.array([env.step([0.05, 0])[0] for _ in range(80)])
    x, y, z = obs[:, 3:6].T
    assert y[0] == pytest.approx(4) and y[-1] > 6 and (np.diff(y) > -1e-9).all()
    assert (y - obs[:, 1] > 2).all()  # the point stays before the block
    assert abs(x).max() < 0.01 and (z == 1).all()


def test_fast_the_point_drives_through_the_block_as_in_the_original():
    env = make("PointPush-v1")
    place(env, 0, 0, heading=math.pi / 2)
    for step in range(1, 11):
        obs, _, terminated, *_ = env.step([0.9, 0])
        assert terminated == (step == 10)  # at y = 9, less than 0.6 from the goal
    assert abs(obs[4] - 3.9) < 0.1  # where the original's is then


def test_ant_pushes_the_block():
    env = make("AntPush-v1")
    place(env, 0, 2.5, v1=2)  # the block's face is at y = 4
    for _ in range(40):
        env.data.qvel[1] = 2
        obs = env.step(np.zeros(8))[0]
    assert obs[4] > 8.3 and abs(obs[3]) < 1 and obs[5] == 2
    assert obs[4] - obs[1] > 4  # it has not gone into the block


# --- Rendering


@pytest.mark.parametrize("env_id", ["AntPush-v1", "Swimmer4Rooms-v1"])
def test_picture_shows_robot_goal_and_walls(env_id):
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render().astype(int)
    env.close()
    assert image.shape == (480, 480, 3)
    r, g, b = image.transpose(2, 0, 1)
    assert ((r > b + 90) & (g > b + 25) & (r > g + 40)).sum() > 40  # the robot, orange
    assert ((g > r + 60) & (g > b + 60)).sum() > 40  # the goal, green
    assert ((b > r + 25) & (b > g + 10)).sum() > 20000  # the walls, blue-gray
    red = ((r > g + 100) & (r > b + 100)).sum()
    assert (red > 5000) == ("Push" in env_id)  # the blocks

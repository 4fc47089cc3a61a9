"""Making environments: one line for a user's mistake, all of a user's own error, little memory."""

import copy
import pickle
import subprocess
import sys

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from conftest import ROOT

import environments
from environments import make_env, make_render_env, make_vector_env, record_video


class Still(gym.Env):
    """Does nothing, with any spaces; rendered as `picture`."""

    metadata = {"render_modes": ["rgb_array"]}
    observation_space = action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    picture = np.zeros((8, 8, 3), np.uint8)

    def __init__(self, render_mode=None, **attributes):
        self.render_mode = render_mode
        for name, value in attributes.items():
            setattr(self, name, value)

    def reset(self, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        self.last_action = action
        return self.observation_space.sample(), 0.0, False, False, {}

    def render(self):
        return self.picture


gym.register("Still-v0", Still, max_episode_steps=3)


def run(code, folder):
    """Runs Python code as the script runs: this project on the path, not the current folder."""
    path = f"import sys; sys.path.insert(0, {str(ROOT)!r}); "
    command = [sys.executable, "-P", "-c", path + code]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


# --- Users' mistakes, and their own environments


@pytest.mark.parametrize(
    "env_id, words",
    [
        ("MyReach-v4", ["unknown environment MyReach-v4", "my_env:MyReach-v4"]),
        ("Pendulum-v9", ["Pendulum-v9; did you mean Pendulum-v1"]),
        ("dm_control/cheetah-fly-v0", ["did you mean dm_control/cheetah-run-v0"]),
        ("0123456789", ["unknown environment 0123456789"]),
        ("no_such_module:Mine-v0", ["no no_such_module.py in the current folder"]),
        ("no_such.module:Mine-v0", ["no package no_such.module"]),
        ("mazes:PointUMazes-v1", ["mazes:PointUMazes-v1; did you mean mazes:PointUMaze-v1"]),
        ("a:b:c", ["a:b is not the name of a module"]),
        ("./my_env:Mine-v0", ["./my_env is not the name of a module"]),
        (
            "my_env.py:Mine-v0",
            ["my_env.py is not the name of a module (that of my_env.py is my_env)"],
        ),
        ("CartPole-v1", ["Discrete(2)"]),
        ("Pendulum-v0", ["deprecated"]),
        ("", ["Malformed"]),
    ],
)
def test_mistakes_in_ids_are_one_line(env_id, words):
    with pytest.raises(gym.error.Error) as caught:
        make_env(env_id)
    message = str(caught.value)
    assert all(word in message for word in words), message
    assert "mean ?" not in message and "\n" not in message


@pytest.mark.parametrize(
    "observations, actions",
    [
        (gym.spaces.Sequence(gym.spaces.Box(-1, 1)), None),
        (gym.spaces.Dict(a=gym.spaces.Sequence(gym.spaces.Box(-1, 1))), None),
        (gym.spaces.Graph(gym.spaces.Box(-1, 1), None), None),
        (None, gym.spaces.Box(0, 9, (1,), np.int64)),
        (None, gym.spaces.MultiDiscrete([2, 2])),
    ],
)
def test_unfit_spaces_are_one_line(observations, actions):
    kwargs = {"observation_space": observations, "action_space": actions}
    with pytest.raises(gym.error.Error, match="Still-v0 has (observations|actions) "):
        make_env("Still-v0", **{k: v for k, v in kwargs.items() if v is not None})


@pytest.mark.parametrize("dtype", [np.float16, np.float64])
def test_actions_of_any_floating_type(dtype):
    env = make_env("Still-v0", action_space=gym.spaces.Box(-2, 2, (2,), dtype))
    env.reset()
    env.step(np.array([0.5, 3], np.float32))
    assert env.unwrapped.last_action.tolist() == [0.5, 3]


MINE = """
import gymnasium as gym, numpy as np
class Mine(gym.Env):
    observation_space = action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    def __init__(self, fault=None):
        if fault: exec(fault)
    def reset(self, seed=None, options=None): return np.zeros(1, np.float32), {}
    def step(self, action): return np.zeros(1, np.float32), 0.0, True, False, {}
gym.register("Mine-v0", Mine)
faults = ["import nothing_there", "gym.make('Nope-v0')", "open('nope')", "1 / 0"]
for i, fault in enumerate(faults):
    gym.register(f"Faulty{i}-v0", Mine, kwargs={"fault": fault})
"""


def test_an_environment_beside_the_user(tmp_path):
    (tmp_path / "my_env.py").write_text(MINE)
    (tmp_path / "random.py").write_text("1 / 0")  # hides nothing
    code = "from environments import *; print(make_vector_env('my_env:Mine-v0', 2).num_envs)"
    done = run(code, tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "2\n", "")


@pytest.mark.parametrize(
    "name, error, line",
    [
        ("my_env:Faulty0-v0", ModuleNotFoundError, "nothing_there"),
        ("my_env:Faulty1-v0", RuntimeError, "Nope"),
        ("my_env:Faulty2-v0", FileNotFoundError, "nope"),
        ("my_env:Faulty3-v0", ZeroDivisionError, "division"),
        ("broken_import:Mine-v0", ModuleNotFoundError, "nothing_there"),
        ("broken_module:Mine-v0", ZeroDivisionError, "division"),
    ],
)
def test_errors_of_the_users_own_code_are_not_made_one_line(
    tmp_path, monkeypatch, name, error, line
):
    """No gymnasium.error.Error, which callers print as one line, and they lead to their cause."""
    (tmp_path / "my_env.py").write_text(MINE)
    (tmp_path / "broken_import.py").write_text("import nothing_there")
    (tmp_path / "broken_module.py").write_text("1 / 0")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for module in ("my_env", "broken_import", "broken_module"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    with pytest.raises(error) as caught:
        make_env(name)
    assert not isinstance(caught.value, gym.error.Error)
    assert line in str(caught.value.__cause__ or caught.value)


# --- Rendering


@pytest.mark.parametrize(
    "kwargs, word",
    [
        ({"picture": None}, "NoneType"),
        ({"picture": [np.zeros((8, 8, 3), np.uint8)]}, "list"),
        ({"picture": np.zeros((8, 8), np.uint8)}, r"shape \(8, 8\)"),
    ],
)
def test_what_cannot_be_recorded_is_found_at_the_start(monkeypatch, kwargs, word):
    monkeypatch.setattr(Still, "picture", kwargs["picture"])
    with pytest.raises(gym.error.Error, match=f"cannot render Still-v0: .*{word}"):
        make_render_env("Still-v0")


def test_an_environment_without_render_mode_cannot_be_recorded():
    gym.register("NoRenderMode-v0", lambda: Still(), max_episode_steps=3)
    with pytest.raises(gym.error.Error, match="cannot render NoRenderMode-v0: .*render_mode='rgb"):
        make_render_env("NoRenderMode-v0")


@pytest.mark.parametrize("dt, render_fps, fps", [(None, None, 30), (None, 20, 20), (0.1, 20, 10)])
def test_video_of_an_environment_with_any_dt(monkeypatch, tmp_path, dt, render_fps, fps):
    monkeypatch.setattr(Still, "dt", dt, raising=False)
    monkeypatch.setattr(
        Still, "metadata", {"render_modes": ["rgb_array"], "render_fps": render_fps}
    )
    env = make_render_env("Still-v0")
    assert environments.frames_per_second(env) == fps
    record_video(env, lambda obs: np.zeros((1, 2), np.float32), tmp_path / "videos" / "a.mp4", 1)
    assert (tmp_path / "videos" / "a.mp4").stat().st_size > 0


# --- Quiet


def test_no_warning_of_mujoco_reaches_the_terminal(tmp_path):
    """HalfCheetah's model has a deprecated setting; such a speed makes it unstable."""
    code = (
        "from environments import *; silence(); env = make_env('HalfCheetah-v5'); env.reset(); "
        "env.unwrapped.data.qvel[:] = 1e20; env.step(np.zeros(6))"
    )
    done = run(code, tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert not list(tmp_path.iterdir())  # no MUJOCO_LOG.TXT


# --- Memory, and time limits inside dm_control

SUITE = [
    "cheetah-run",
    "cartpole-swingup_sparse",
    "ball_in_cup-catch",
    "reacher-hard",
    "walker-run",
]


@pytest.mark.parametrize("task", SUITE)
def test_models_without_textures_move_the_same(task):
    """Bit for bit, beside dm_control's own, whose textures are whole again afterwards."""
    small = make_env(f"dm_control/{task}-v0")
    whole = gym.make(f"dm_control/{task}-v0", disable_env_checker=True)
    assert small.unwrapped._env.physics.model.tex_data.nbytes < 1000
    assert whole.unwrapped._env.physics.model.tex_data.nbytes > 10_000_000
    assert_same(small, environments.FlatSpaces(whole))


def test_the_door_without_what_is_only_seen_moves_the_same():
    small, whole = (
        gym.make("door-v0").unwrapped,
        gym.make("door-v0", render_mode="rgb_array").unwrapped,
    )
    assert small.model.ntex == small.model.nmesh == 0 < whole.model.ntex
    assert_same(small, whole)


def assert_same(one, other, n_steps=200):
    rng = np.random.default_rng(0)
    assert one.reset(seed=3)[0].tobytes() == other.reset(seed=3)[0].tobytes()
    for _ in range(n_steps):
        action = rng.uniform(one.action_space.low, one.action_space.high).astype(np.float32)
        (obs, reward, *_), (other_obs, other_reward, *_) = one.step(action), other.step(action)
        assert obs.tobytes() == other_obs.tobytes() and reward == other_reward


def test_a_longer_time_limit_replaces_the_one_inside_dm_control():
    envs = make_vector_env("dm_control/pendulum-swingup-v0", 1, max_episode_steps=1003)
    envs.reset(seed=[1])
    ends = [bool(envs.step(np.zeros((1, 1), np.float32))[3][0]) for _ in range(1003)]
    assert ends == [False] * 1002 + [True]


def test_a_longer_time_limit_and_other_arguments_of_the_task():
    name, given = "dm_control/pendulum-swingup-v0", {"task_kwargs": {"random": 1}}
    env = make_env(name, max_episode_steps=1003, env_kwargs=given)
    env.reset(seed=1)
    ends = [any(env.step(np.zeros(1, np.float32))[2:4]) for _ in range(1003)]
    assert ends == [False] * 1002 + [True]


def test_a_name_without_its_version_is_refused():
    for name in ("MountainCarContinuous", "dm_control/pendulum-swingup"):
        with pytest.raises(gym.error.UnregisteredEnv, match=f"did you mean {name}-v0"):
            make_env(name)


def through_pickle(env):
    return pickle.loads(pickle.dumps(env))


@pytest.mark.parametrize("duplicate", [copy.deepcopy, through_pickle])
def test_copies_of_the_door_go_on_and_start_again_alike(duplicate):
    env = gym.make("door-v0")
    env.reset(seed=1)
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 28))
    for action in actions:
        env.step(action)
    twin = duplicate(env)
    steps = [[e.step(a)[:2] for a in actions] for e in (env, twin)]  # one after the other
    for (obs, reward), (twin_obs, twin_reward) in zip(*steps, strict=True):
        assert obs.tobytes() == twin_obs.tobytes() and reward == twin_reward
    assert_same(twin, gym.make("door-v0"), 20)
    assert isinstance(twin.unwrapped.model, mujoco.MjModel)

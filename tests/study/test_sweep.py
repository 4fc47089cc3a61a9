"""The lists of runs that run_sweep.sh works on."""

import re
import shlex
import subprocess
import sys

import pytest

import ppo_colored_continuous as ppo
from study import sweep
from study.protocol import PRESETS


def runs(arguments):
    return sweep.list_runs(sweep.parse_args(shlex.split(arguments)))


def flags(command, *names):
    """The values of flags in a command; None for those that it does not have."""
    words = shlex.split(command)
    return tuple(words[words.index(name) + 1] if name in words else None for name in names)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets(preset):
    """Each is as large as its line in the help says, and no two runs share a folder."""
    found = runs(preset)
    size = int(re.search(rf"^  {preset} .* (\d+)$", sweep.__doc__, re.M)[1])
    assert len(found) == len(dict(found)) == len({command for _, command in found}) == size
    assert all(" --resume" in command for _, command in found)
    ids = {flags(command, "--env-id") for _, command in found}
    assert len(ids) == {"quick": 1, "complex": 4, "gymnasium": 6}.get(preset, 16)


def test_narrowing_and_quoting(monkeypatch):
    monkeypatch.setenv("PYTHON", "a python")
    narrowed = "main --envs 'dm_control/cheetah-run-v0 PointUMaze' --betas '0 0.50 -1 -0 auto'"
    narrowed += " --n-envs 4 --seeds '3 1' --runs-dir 'my runs/a' --exp-name x"
    found = runs(narrowed + """ -- --note "it's $HOME; a b" --no-compile""")
    axes = [flags(c, "--env-id", "--beta", "--n-envs", "--seed") for _, c in found]
    ids = ["dm_control/cheetah-run-v0", "PointUMaze-v1"]
    words = ["0", "0.5", "-1", "auto"]
    assert axes == [(env, beta, "4", seed) for seed in "31" for env in ids for beta in words]
    folder, command = found[1]
    assert folder == "my runs/a/x/dm_control_cheetah-run-v0/beta_0.5/n_envs_4/seed_3"
    assert shlex.split(command)[0] == "a python"
    assert shlex.split(command)[-3:] == ["--note", "it's $HOME; a b", "--no-compile"]
    for _, command in found:  # the paper's dm_control runs had no bootstrap at time limits
        assert ("--no-bootstrap-timeouts" in command) == ("dm_control" in command)


def test_any_environment():
    envs = "cheetah-run dm_control/cheetah-run Ant4Rooms HalfCheetah-v5 my_env:Mine my_env:Mine-v0"
    found = runs(f"quick --envs '{envs}' --betas 0 --seeds 1")  # the second is the first
    ids = [flags(command, "--env-id")[0] for _, command in found]
    own = ["my_env:Mine", "my_env:Mine-v0"]
    assert ids == ["dm_control/cheetah-run-v0", "Ant4Rooms-v1", "HalfCheetah-v5", *own]


def test_n_steps_keeps_the_update_size():
    found = runs("n_steps --envs door --seeds 1")
    values = [flags(command, "--n-envs", "--n-steps", "--exp-name") for _, command in found]
    name = "ppo_colored_continuous"  # with the defaults it is main's own run
    expected = [("2", "4096", f"{name}_n_steps_4096"), ("4", None, name)]
    assert values == [*expected, ("8", "1024", f"{name}_n_steps_1024")]


def test_other_methods():
    narrowed = "--envs door --seeds 1 --n-envs 4"
    found = runs(f"transfer {narrowed} --betas 0.5 --exp-name x") + runs(f"gsde {narrowed}")
    assert [folder for folder, _ in found] == [
        "runs/x_trpo/door-v0/beta_0.5/n_envs_4/seed_1",
        "runs/x_a2c/door-v0/beta_0.5/n_envs_4/seed_1",
        "runs/gsde/door-v0/gsde/n_envs_4/seed_1",
    ]
    methods = [re.search(r" -m study.methods (\w+) ", command)[1] for _, command in found]
    assert methods == ["trpo", "a2c", "gsde"]
    assert [flags(command, "--beta")[0] for _, command in found] == ["0.5", "0.5", None]


WRONG = """
mane | main 4 | main --foo | main --envs PontUMaze | main --betas 0,5 | main --seeds ' '
main --n-envs 1.5 | main -j 0 | main --print --slurm 2 | main --slurm 0 | gymnasium --n-envs 4
vanilla --betas 0 | main -- --seed 3 | n_steps -- --n-steps=5
"""


@pytest.mark.parametrize("arguments", re.split(r" \| |\n", WRONG.strip()))
def test_wrong_usage(arguments, capsys):
    with pytest.raises(SystemExit) as error:
        runs(arguments)
    assert error.value.code == 2
    assert "run_sweep.sh: error: " in capsys.readouterr().err


def test_nothing_slow_is_imported():
    code = "import sys, study.sweep; print(*{'torch', 'gymnasium', 'numpy'} & sys.modules.keys())"
    assert subprocess.check_output([sys.executable, "-c", code], cwd=sweep.ROOT) == b"\n"


@pytest.mark.parametrize(
    "arguments",
    [
        'main --envs "Point4Rooms-v1 cheetah-run my_env:X-v0" --betas "-1 0.5 auto" --n-envs 8',
        "vanilla --n-envs 1 --seeds 3",
        "n_steps --exp-name slow --seeds 1",
        "n_epochs --runs-dir elsewhere --seeds 1",
        "transfer --seeds 2",
        "gsde --seeds 2 --n-envs 4",
    ],
)
def test_folders_are_those_of_the_script(arguments):
    """Which the sweep cannot ask, as importing it takes seconds."""
    for folder, command in runs(arguments):
        words = shlex.split(command)
        methods = "study.methods" in words
        start = words.index("study.methods") + 2 if methods else words.index("--env-id")
        method = words[start - 1] if methods else "ppo"
        args = ppo.parse_args(words[start:], method=method)
        assert str(folder) == str(ppo.run_path(args))

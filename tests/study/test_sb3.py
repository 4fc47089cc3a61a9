"""study.sb3: Stable-Baselines3 as the paper's stack has it, with the script's flags."""

import numpy as np
import pytest
import torch

from study import sb3

PENDULUM = "dm_control/pendulum-swingup-v0"


def parse(flags):
    return sb3.parse_args(flags.split())


def test_a_run(tmp_path, read_evaluations):
    """Evaluated after updates, with the script's files, and the same again with the same seed."""
    flags = "--env-id Pendulum-v1 --n-envs 2 --n-steps 64 --total-timesteps 512 --eval-freq 256 "
    flags += f"--eval-episodes 2 --n-epochs 1 --runs-dir {tmp_path}"
    for name in "ab":
        sb3.main(parse(f"{flags} --exp-name {name}"))
    sb3.main(parse(f"{flags} --exp-name c --seed 2"))
    a, b, c = (read_evaluations(next(tmp_path.glob(f"{x}/*/beta_0.5/n_envs_2/*"))) for x in "abc")
    assert [(row["step"], row["length_mean"]) for row in a] == [(256, 200), (512, 200)]
    assert a == b and a[0]["return_mean"] != c[0]["return_mean"]
    (best,) = tmp_path.glob("a/**/best.pt")
    assert "action_net.weight" in torch.load(best, weights_only=True)["agent"]


@pytest.mark.parametrize("flags, truncated", [("", True), ("--no-bootstrap-timeouts", False)])
def test_a_time_limit_is_an_end_where_there_is_no_bootstrap(flags, truncated):
    envs = sb3.make_envs(parse(f"--env-id {PENDULUM} --eval-freq 8192 {flags}"), 1, seed=1)
    envs.reset()
    for _ in range(1000):
        _, _, done, infos = envs.step(np.zeros((1, 1)))
    assert done[0] and infos[0]["TimeLimit.truncated"] == truncated


def test_noise():
    """White noise is Stable-Baselines3's own; a color is that of the paper's package."""
    for flags, correlation in (("--vanilla", 0), ("--beta 2", 1)):
        model = sb3.make_model(parse(f"--eval-freq 8192 {flags}"))
        obs = torch.zeros(4, 2)
        with torch.no_grad():
            actions = np.array([model.policy(obs)[0].numpy() for _ in range(1000)])  # (1000, 4, 1)
        assert actions.std() == pytest.approx(1, abs=0.4)
        lag_1 = np.mean(actions[1:] * actions[:-1]) / np.mean(actions**2)
        assert lag_1 == pytest.approx(correlation, abs=0.1)


@pytest.mark.parametrize(
    "flags", ["--anneal-lr", "--normalize-obs", "--beta auto", "--eval-freq 100"]
)
def test_flags_that_do_not_apply_are_refused(flags):
    with pytest.raises(SystemExit) as stopped:
        parse(flags)
    assert flags.split()[0] in str(stopped.value)

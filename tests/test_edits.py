"""Edits that students make, each in a copy of the script: they take effect, or fail with a message.

An edit is a list of (old line, new line). The copy is run; the tests look at what it left behind.
"""

import ast
import importlib.util
import sys

import numpy as np
import pytest
import torch
from conftest import SCRIPT
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import run_files
from environments import make_vector_env

FLAGS = "--env-id Pendulum-v1 --total-timesteps 2048 --n-envs 2 --n-steps 256 --eval-freq 1024 "
FLAGS += "--eval-episodes 2 --n-epochs 1 --learning-rate 1e-2 --overwrite"


def edit(tmp_path, *edits):
    """The script with the edits, as a module."""
    text = SCRIPT.read_text()
    for old, new in edits:
        assert old in text, f"the script has no longer: {old}"
        text = text.replace(old, new)
    path = tmp_path / "edited.py"
    path.write_text(text)
    spec = importlib.util.spec_from_file_location("edited", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["edited"] = module
    spec.loader.exec_module(module)
    return module


def run(module, tmp_path, flags="--no-compile", **kwargs):
    """Runs it; returns the final agent, its evaluated final return, and TensorBoard's points."""
    args = module.parse_args(f"{FLAGS} --runs-dir {tmp_path / 'runs'} {flags}".split())
    module.main(args, **kwargs)
    folder = run_files.run_path(vars(args))
    checkpoint = torch.load(folder / "checkpoint.pt", weights_only=True)
    agent = module.Agent(3, 1).requires_grad_(False)
    agent.load_state_dict(checkpoint["agent"])
    events = EventAccumulator(str(folder)).Reload()
    scalars = {tag: [e.value for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    return agent, scalars["evaluation/return_mean"][-1], scalars


def parameters(agent):
    return torch.nn.utils.parameters_to_vector(agent.parameters())


@pytest.fixture
def original(tmp_path):
    return run(edit(tmp_path), tmp_path)


RATE = "learning_rate = args.learning_rate * (1 - global_step / total if args.anneal_lr else 1)"


@pytest.mark.parametrize("flags", ["--no-compile", ""])
def test_annealing_by_hand(tmp_path, flags):
    """A learning rate set in the loop is used, compiled or not, and is what --anneal-lr does."""
    module = edit(
        tmp_path, (RATE, "learning_rate = args.learning_rate * (1 - global_step / total)")
    )
    by_hand, _, scalars = run(module, tmp_path, flags)
    constant, *_ = run(edit(tmp_path), tmp_path, flags)
    flag, *_ = run(edit(tmp_path), tmp_path, f"{flags} --anneal-lr")
    assert torch.equal(parameters(by_hand), parameters(flag))
    assert (parameters(by_hand) - parameters(constant)).abs().max() > 1e-3
    np.testing.assert_allclose(scalars["losses/learning_rate"], [1e-2, 7.5e-3, 5e-3, 2.5e-3])


def test_arguments_are_read_only(tmp_path):
    module = edit(tmp_path, (RATE, f"args.learning_rate *= 0.5\n            {RATE}"))
    with pytest.raises(AttributeError, match="args.learning_rate is read-only.*handed on"):
        run(module, tmp_path)


HIDDEN = "*(layer_init(nn.Linear(64, 64)), nn.Tanh()),"


@pytest.mark.parametrize(
    "edits, in_numpy",
    [
        ([("nn.Tanh()", "nn.ReLU()")], True),
        ([(HIDDEN, f"{HIDDEN}\n                {HIDDEN}")], True),
        ([(HIDDEN, f"nn.LayerNorm(64), {HIDDEN}")], False),
        ([("nn.Tanh()", "nn.GELU()")], False),
    ],
    ids=["ReLU", "third hidden layer", "LayerNorm", "GELU"],
)  # fmt: skip
def test_layers(tmp_path, original, edits, in_numpy):
    """What is evaluated and acts is the module that learns."""
    module = edit(tmp_path, *edits)
    agent, final_return, _ = run(module, tmp_path)
    obs = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    policy = run_files.numpy_policy(agent.actor_mean)
    torch.testing.assert_close(
        torch.tensor(policy(obs)), agent.actor_mean(torch.tensor(obs)), rtol=1e-5, atol=1e-6
    )
    assert (policy.__name__ == "policy") == in_numpy

    def mean_action(obs):
        return agent.actor_mean(torch.tensor(obs)).numpy()

    envs = make_vector_env("Pendulum-v1", 2)
    returns, _ = module.evaluate(mean_action, envs, run_files.make_seeds(2, 1, 2, 2048))
    assert returns.mean() == pytest.approx(final_return, rel=1e-3)
    assert final_return != pytest.approx(original[1], rel=1e-3)


LOG_STD = "self.log_std = nn.Parameter(torch.zeros(action_dim))"
CRITIC = "self.critic = mlp(1, gain=1.0)"


def test_a_fixed_std(tmp_path, capsys):
    """As a buffer it stays as it is; a parameter that is not to be learned is refused."""
    frozen = LOG_STD[:-1] + ", requires_grad=False)"
    with pytest.raises(SystemExit):
        run(edit(tmp_path, (LOG_STD, frozen)), tmp_path)
    message = capsys.readouterr().err
    assert "log_std has requires_grad=False" in message and message.count("\n") == 1
    buffer = 'self.register_buffer("log_std", torch.zeros(action_dim))'
    agent, _, scalars = run(edit(tmp_path, (LOG_STD, buffer)), tmp_path)
    assert scalars["rollout/std"] == [1.0] * 4 and len(parameters(agent)) == 8962


@pytest.mark.parametrize("flags", ["--no-compile", ""])
def test_a_trunk_that_actor_and_critic_share(tmp_path, original, flags):
    head = "layer_init(nn.Linear(64, 1), 1.0)"
    shared = f"self.critic = nn.Sequential(*self.actor_mean[:-1], {head})"
    agent, final_return, scalars = run(edit(tmp_path, (CRITIC, shared)), tmp_path, flags)
    assert agent.critic[0] is agent.actor_mean[0] and final_return != original[1]
    trunk = agent.actor_mean[0].weight
    fresh = torch.linalg.svdvals(trunk)  # it begins orthogonal, times the root of two
    assert (fresh - 2**0.5).abs().max() > 1e-3 and np.isfinite(scalars["losses/value_loss"]).all()


@pytest.mark.parametrize(
    "line, alias",
    [(CRITIC, "self.critic[0].weight = self.actor_mean[0].weight")]
    + [(LOG_STD, "self.scale = self.log_std")],
)
def test_one_parameter_with_two_names_is_refused(tmp_path, capsys, line, alias):
    with pytest.raises(SystemExit):
        run(edit(tmp_path, (line, f"{line}\n        {alias}")), tmp_path)
    assert "are one parameter: give it one name" in capsys.readouterr().err


def test_a_hook_acts():
    actor = torch.nn.Sequential(torch.nn.Linear(3, 1)).requires_grad_(False)
    actor.register_forward_hook(lambda module, inputs, output: 0 * output + 1.5)
    assert run_files.numpy_policy(actor)(np.ones((1, 3), np.float32)) == 1.5


def test_an_agent_changed_in_the_loop_acts(tmp_path):
    """Its mean and its std: the actions are those that the log-probabilities are of."""
    line = "            act = exploration(agent, noise, args)"
    changed = "            agent.actor_mean[-1].bias += 1.7\n            agent.log_std -= 9\n"
    batches = []

    def learn(agent, optimizer, batch, *_):
        batches.append((batch[1].clone(), agent.actor_mean(batch[0])))
        return optimizer, {}

    run(edit(tmp_path, (line, changed + line)), tmp_path, learn=learn)
    for i, (actions, means) in enumerate(batches):
        assert means.mean() > 1.5 * (i + 1)
        torch.testing.assert_close(actions, means, atol=1e-3, rtol=0)


def test_another_optimizers_state_is_resumed(tmp_path):
    """With a plain number in it, say."""
    step = "step = torch.zeros((), dtype=torch.float64, device=args.device)"
    module = edit(tmp_path, (step, "step = 0"))
    run(module, tmp_path)
    (folder,) = (path.parent for path in tmp_path.rglob("summary.json"))
    (folder / "summary.json").unlink()
    flags = FLAGS.replace("--overwrite", f"--resume --no-compile --runs-dir {tmp_path / 'runs'}")
    module.main(module.parse_args(flags.split()))
    assert (folder / "summary.json").exists()


def test_dropout_is_off_in_the_policy():
    actor = torch.nn.Sequential(torch.nn.Linear(3, 64), torch.nn.Dropout(), torch.nn.Linear(64, 1))
    policy = run_files.numpy_policy(actor.requires_grad_(False))
    obs = np.ones((1, 3), np.float32)
    assert policy(obs) == policy(obs) and actor.training


def test_an_edit_does_not_fit_an_earlier_checkpoint(tmp_path, capsys):
    """And --resume loses nothing of the run that is there."""
    run(edit(tmp_path), tmp_path)
    (folder,) = (path.parent for path in tmp_path.rglob("summary.json"))
    (folder / "summary.json").unlink()
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    module = edit(tmp_path, (HIDDEN, f"nn.LayerNorm(64), {HIDDEN}"))
    flags = FLAGS.replace("--overwrite", "--resume --no-compile")
    with pytest.raises(SystemExit) as ended:
        module.main(module.parse_args(f"{flags} --runs-dir {tmp_path / 'runs'}".split()))
    (line,) = capsys.readouterr().err.splitlines()[-1:]
    assert ended.value.code == 1 and "does not fit this script" in line and "Missing key" in line
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("flags", ["--no-compile", ""])
def test_log_the_gradient_norm(tmp_path, flags):
    line = "    params, optimizer = adam(params, grads, optimizer, learning_rate)"
    module = edit(tmp_path, (line, '    metrics["grad_norm"] = grads.norm()\n' + line))
    _, _, scalars = run(module, tmp_path, flags)
    norms = scalars["losses/grad_norm"]  # after clipping at 0.5
    assert len(norms) == 4 and all(0 < norm <= 0.5001 for norm in norms)


AR1 = """def ar1(shape):
    eps = torch.randn(shape)
    for t in range(1, len(eps)):
        eps[t] = 0.9 * eps[t - 1] + (1 - 0.9**2) ** 0.5 * eps[t]
    return eps


def exploration("""


def test_another_noise(tmp_path):
    """AR(1), the discrete Ornstein-Uhlenbeck process, in place of 1/f noise."""
    module = edit(tmp_path, ("noise.sample(args.n_steps)", "ar1(shape)"), ("def exploration(", AR1))
    batches = []

    def learn(agent, optimizer, batch, *_):
        batches.append(batch[1].view(256, 2).clone())
        return optimizer, {}

    run(module, tmp_path, learn=learn)
    actions = torch.cat(batches)
    correlation = torch.corrcoef(torch.stack([actions[:-1, 0], actions[1:, 0]]))[0, 1]
    assert correlation.item() == pytest.approx(0.9, abs=0.05)


NORMALIZE = """class NormalizeObservations(gym.vector.VectorWrapper):
    mean, var, n = 0, 1, 1e-4

    def normalize(self, obs):
        rate = len(obs) / (self.n + len(obs))
        self.n += len(obs)
        change = obs.mean(0) - self.mean
        self.var = (1 - rate) * (self.var + rate * change**2) + rate * obs.var(0)
        self.mean = self.mean + rate * change
        return ((obs - self.mean) / np.sqrt(self.var + 1e-8)).clip(-10, 10).astype(np.float32)

    def reset(self, **kwargs):
        obs, infos = self.env.reset(**kwargs)
        return self.normalize(obs), infos

    def step(self, actions):
        obs, rewards, terminated, truncated, infos = self.env.step(actions)
        return self.normalize(obs), rewards, terminated, truncated, infos


def main("""


def test_normalize_observations_by_a_wrapper(tmp_path):
    """Written out, since Gymnasium's own for vector environments refuse SAME_STEP autoreset."""
    make = "        envs, eval_envs, video_env, normalization = environments.make_envs(args)\n"
    wrap = f"{make}        envs = NormalizeObservations(envs)\n"
    module = edit(tmp_path, (make, wrap), ("def main(", NORMALIZE))
    observations = []

    def learn(agent, optimizer, batch, *_):
        observations.append(batch[0].clone())
        return optimizer, {}

    run(module, tmp_path, learn=learn)
    std = torch.cat(observations)[256:].std(0)  # of the angular velocity it would be about 2
    assert ((std > 0.7) & (std < 1.3)).all()


@pytest.mark.parametrize("flags", ["--no-compile", ""])
def test_print_in_the_loss(tmp_path, capsys, flags):
    line = "    ratio = log_ratio.exp()"
    module = edit(tmp_path, (line, f'{line}\n    print("ratio", ratio.mean())'))
    run(module, tmp_path, flags)
    out, err = capsys.readouterr()
    assert out.count("ratio") >= 16  # 4 updates of 4 minibatches
    assert ("going on without torch.compile" in err) == (flags == "")


@pytest.mark.parametrize("flags", ["--no-compile", ""])
def test_a_mistake_in_the_loss_is_a_traceback(tmp_path, flags):
    module = edit(tmp_path, ("    ratio = log_ratio.exp()", "    ratio = log_ratio.expp()"))
    with pytest.raises(AttributeError, match="expp"):
        run(module, tmp_path, flags)


def test_the_module_is_what_counts(tmp_path):
    """What the loop does to the agent's parameters is what the next update starts from."""
    line = "            optimizer, metrics = learn("
    freeze = "            agent.log_std.data = torch.full((1,), -2.0)\n"
    agent, *_ = run(edit(tmp_path, (line, freeze + line)), tmp_path, "--no-compile --n-epochs 1")
    assert agent.log_std.item() == pytest.approx(-2, abs=0.1)  # one update away


def nesting(node, depth=0):
    blocks = (ast.For, ast.While, ast.If, ast.With, ast.Try, ast.FunctionDef)
    deeper = depth + isinstance(node, blocks)
    return max([deeper, *(nesting(child, deeper) for child in ast.iter_child_nodes(node))])


def test_the_script_stays_readable():
    """The house rules: lines, length of functions, nesting, and no name used before it is there."""
    text = SCRIPT.read_text()
    assert text.count("\n") <= 425 and max(map(len, text.splitlines())) <= 100
    for function in ast.walk(ast.parse(text)):
        if not isinstance(function, ast.FunctionDef):
            continue
        length = function.end_lineno - function.lineno + 1
        assert length <= 60 or function.name in ("main", "parse_args"), function.name
        assert max(nesting(node) for node in function.body) <= 4, function.name
        inner = [node for node in ast.walk(function) if isinstance(node, ast.FunctionDef)][1:]
        for nested in inner:
            names = {node.id for node in ast.walk(nested) if isinstance(node, ast.Name)}
            later = {
                node.id
                for node in ast.walk(function)
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
                if node.lineno > nested.end_lineno
            }
            assert not names & later, f"{nested.name} in {function.name}"

import colorednoise
import numpy as np
import pytest
import torch
from scipy import stats

from colored_noise import (
    ColoredNoiseProcess,
    autocovariance,
    colored_noise,
    expected_psd,
    marginal_variance,
    mean_std,
)

BETAS = [-1, 0, 0.2, 0.5, 0.75, 1, 1.25, 2]


def draw(beta, n, T, seed=0):
    return colored_noise(beta, (n, T), generator=torch.Generator().manual_seed(seed)).double()


@pytest.mark.parametrize("beta", BETAS)
def test_psd_falls_as_f_to_the_minus_beta(beta):
    psd = torch.fft.rfft(draw(beta, 2000, 1000)).abs().square().mean(0).numpy()
    f = np.fft.rfftfreq(1000)
    slope = np.polyfit(np.log(f[1:-1]), np.log(psd[1:-1]), 1)[0]
    assert slope == pytest.approx(-beta, abs=0.02)


@pytest.mark.parametrize("T", [2, 3, 100, 101])
@pytest.mark.parametrize("beta", [-1, 0, 0.5, 2])
def test_draws_agree_with_the_closed_forms(beta, T):
    n = 40_000
    x = draw(beta, n, T)
    error = 5 * (2 / n) ** 0.5  # five standard errors of a variance estimate, relative

    psd = torch.fft.rfft(x).abs().square().mean(0)
    assert torch.allclose(psd, expected_psd(beta, T), rtol=5 * n**-0.5 * 2**0.5)
    assert torch.allclose(x.var(0), marginal_variance(beta, T).expand(T), rtol=error)
    assert x.mean(1).std().item() == pytest.approx(mean_std(beta, T).item(), rel=error)
    covariance = (x[:, :1] * x).mean(0)
    assert torch.allclose(
        covariance, autocovariance(beta, T), atol=error * marginal_variance(beta, T).item()
    )


def test_closed_forms_have_the_published_values():
    variances = [marginal_variance(beta, 1000).item() for beta in (0, 0.5, 1, 2)]
    assert variances == pytest.approx([1.0015, 1.0118, 1.0737, 1.3043], abs=5e-5)
    bias = [mean_std(beta, 1000).item() for beta in (0, 0.5, 1, 2)]
    assert bias == pytest.approx([0.0316, 0.1075, 0.2713, 0.5517], abs=6e-5)
    assert autocovariance(0, 1000)[1:].abs().max() < 2e-3 and autocovariance(1, 1000)[1] > 0.8
    assert expected_psd(torch.tensor([0.0, 1.0]), 10).shape == (2, 6)


@pytest.mark.parametrize("T", [100, 101])
@pytest.mark.parametrize("beta", [0, 0.5, 2])
def test_agrees_with_the_colorednoise_package_in_distribution(beta, T):
    n = 20_000
    theirs = colorednoise.powerlaw_psd_gaussian(beta, (n, T), random_state=1)
    ours = draw(beta, n, T).numpy()
    # single values, steps, and sequence means: marginal, two-step correlation and the DC bin
    for feature in (
        lambda x: x[:, 3],
        lambda x: x[:, 4] - x[:, 3],
        lambda x: x.mean(1),
        lambda x: x[:, 3] + x[:, 50],
    ):
        assert stats.ks_2samp(feature(ours), feature(theirs)).pvalue > 1e-3
    ours_psd, theirs_psd = (np.mean(np.abs(np.fft.rfft(x)) ** 2, axis=0) for x in (ours, theirs))
    np.testing.assert_allclose(ours_psd, theirs_psd, rtol=5 * (2 / n) ** 0.5 * 2**0.5)


def test_same_as_the_colorednoise_package_on_the_same_random_numbers(monkeypatch):
    """With its normal draws fed to ours, the sequences are equal: scales, special bins and sigma are all the same."""
    for T in (100, 101):
        for beta in BETAS:
            theirs = colorednoise.powerlaw_psd_gaussian(beta, T, random_state=7)
            f = np.fft.rfftfreq(T)
            s = np.maximum(f, 1 / T) ** (-beta / 2)
            rng = np.random.default_rng(7)
            real, imaginary = (rng.normal(scale=s) / s for _ in range(2))
            normals = torch.tensor(np.stack([real, imaginary], -1), dtype=torch.float32)
            monkeypatch.setattr(
                torch, "randn", lambda *size, normals=normals, **_: normals.reshape(size).clone()
            )
            ours = colored_noise(beta, (T,))
            monkeypatch.undo()
            np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=2e-5)


def test_sequences_of_environments_and_dimensions_are_independent():
    process = ColoredNoiseProcess(1.0, n_envs=3, action_dim=2, seq_len=1000, seed=1)
    means = torch.stack([process.sample(1000).mean(0).flatten() for _ in range(4000)])  # (4000, 6)
    correlation = torch.corrcoef(means.T) - torch.eye(6)
    assert correlation.abs().max() < 5 / 4000**0.5
    # and anew after T steps: successive sequences do not correlate either
    successive = torch.corrcoef(torch.stack([means[:-1, 0], means[1:, 0]]))[0, 1]
    assert abs(successive) < 5 / 4000**0.5


def test_one_beta_per_action_dimension():
    process = ColoredNoiseProcess([0.0, 2.0], n_envs=64, action_dim=2, seed=1)
    x = process.sample(1000)  # (1000, 64, 2)
    step_correlation = (x[1:] * x[:-1]).mean((0, 1))
    assert step_correlation[0].abs() < 0.02 and step_correlation[1] > 0.9


def test_process_continues_over_the_ends_of_sequences():
    """The same values come out one by one and in blocks of any length, across redraws; shapes are as documented."""
    make = lambda: ColoredNoiseProcess(0.5, n_envs=2, action_dim=3, seq_len=10, seed=3)  # noqa: E731
    one, block = make(), make()
    singles = torch.stack([one.sample() for _ in range(35)])
    blocks = torch.cat([block.sample(n) for n in (4, 6, 25)])
    assert singles.shape == (35, 2, 3) and singles.dtype == torch.float32
    assert torch.equal(singles, blocks)
    assert not torch.equal(singles[:10], singles[10:20])
    assert not torch.equal(singles, ColoredNoiseProcess(0.5, 2, 3, 10, seed=4).sample(35))


def test_state_is_restored_in_mid_sequence():
    process = ColoredNoiseProcess(1.0, 2, 1, seq_len=10, seed=3)
    process.sample(7)
    state = {k: v.clone() if torch.is_tensor(v) else v for k, v in process.state_dict().items()}
    expected = process.sample(30)
    other = ColoredNoiseProcess(1.0, 2, 1, seq_len=10, seed=99)
    other.load_state_dict(state)
    assert torch.equal(other.sample(30), expected)
    with pytest.raises(ValueError, match="noise state"):
        ColoredNoiseProcess(1.0, 3, 1, seq_len=10).load_state_dict(state)


def test_draws_do_not_touch_the_global_generator():
    torch.manual_seed(0)
    expected = torch.rand(1)
    torch.manual_seed(0)
    ColoredNoiseProcess(0.5, 4, 2, seed=1).sample(3000)
    assert torch.equal(torch.rand(1), expected)


@pytest.mark.parametrize("beta", [-1e308, -60, 60, 1e308])
def test_any_finite_beta_gives_finite_noise(beta):
    assert draw(beta, 10, 1000).isfinite().all() and marginal_variance(beta, 1000).isfinite()


@pytest.mark.parametrize(
    "beta, size", [(float("nan"), 10), (float("inf"), 10), (0, 1), (0, (0, 10)), ([0, 1], (3, 10))]
)
def test_bad_arguments_are_refused(beta, size):
    with pytest.raises(ValueError):
        colored_noise(beta, size)
    with pytest.raises(ValueError, match="one per action dimension"):
        ColoredNoiseProcess([0.0, 1.0], n_envs=2, action_dim=3)

import io
import math

import colorednoise
import numpy as np
import pytest
import torch

from colored_noise import (
    PUBLISHED_BEST_BETA,
    ColoredNoiseProcess,
    autocovariance,
    colored_noise,
    expected_psd,
    marginal_variance,
    mean_std,
    projected_beta,
)
from study.runs import published
from study.tables import projected_ranks

BETAS = [-1, 0, 0.2, 0.5, 0.75, 1, 1.25, 2]


def draw(beta, n, T, seed=0):
    return colored_noise(beta, (n, T), generator=torch.Generator().manual_seed(seed)).double()


@pytest.mark.parametrize("beta", BETAS)
def test_psd_falls_as_f_to_the_minus_beta(beta):
    f, psd = np.fft.rfftfreq(1000)[1:], expected_psd(beta, 1000).numpy()
    np.testing.assert_allclose(psd[1:] / psd[1], (f / f[0]) ** -beta)
    assert psd[0] == psd[1]


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


def test_same_as_the_colorednoise_package_on_the_same_random_numbers(monkeypatch):
    """With its normal draws fed to ours, the sequences are equal.

    So scales, special bins and sigma are all the same.
    """
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
    means = torch.stack([process.sample(1000).mean(0).flatten() for _ in range(1000)])  # (1000, 6)
    correlation = torch.corrcoef(means.T) - torch.eye(6)
    assert correlation.abs().max() < 5 / 1000**0.5
    # and anew after T steps: successive sequences do not correlate either
    successive = torch.corrcoef(torch.stack([means[:-1, 0], means[1:, 0]]))[0, 1]
    assert abs(successive) < 5 / 1000**0.5


def test_one_beta_per_action_dimension():
    process = ColoredNoiseProcess([0.0, 2.0], n_envs=64, action_dim=2, seed=1)
    x = process.sample(1000)  # (1000, 64, 2)
    step_correlation = (x[1:] * x[:-1]).mean((0, 1))
    assert step_correlation[0].abs() < 0.02 and step_correlation[1] > 0.9


def test_process_continues_over_the_ends_of_sequences():
    """The same values come out one by one and in blocks of any length, across redraws."""

    def make():
        return ColoredNoiseProcess(0.5, n_envs=2, action_dim=3, seq_len=10, seed=3)

    one, block = make(), make()
    singles = torch.stack([one.sample() for _ in range(35)])
    blocks = torch.cat([block.sample(n) for n in (4, 6, 25)])
    assert singles.shape == (35, 2, 3) and singles.dtype == torch.float32
    assert torch.equal(singles, blocks)
    assert not torch.equal(singles[:10], singles[10:20])
    assert block.sample(0).shape == (0, 2, 3)
    with pytest.raises(ValueError, match="negative"):
        block.sample(-1)
    assert not torch.equal(singles, ColoredNoiseProcess(0.5, 2, 3, 10, seed=4).sample(35))
    unseeded = (ColoredNoiseProcess(0.5, 2, 3, 10).sample(35) for _ in range(2))
    assert not torch.equal(*unseeded)


@pytest.mark.parametrize("n_sampled", [0, 7, 10, 25])
def test_a_state_is_small_and_continues_wherever_it_was_taken(n_sampled):
    """Also before the first value and at a sequence's end; through a file, as in a checkpoint."""
    process = ColoredNoiseProcess([0.0, 1.0], 3, 2, seq_len=10, seed=3)
    process.sample(n_sampled)
    file = io.BytesIO()
    torch.save(process.state_dict(), file)
    expected = process.sample(30)
    file.seek(0)
    state = torch.load(file, weights_only=True)
    other = ColoredNoiseProcess([0.0, 1.0], 3, 2, seq_len=10)
    other.load_state_dict(state)
    assert torch.equal(other.sample(30), expected)
    big = io.BytesIO()
    torch.save(ColoredNoiseProcess(0.5, 4, 1, seq_len=100_000, seed=1).state_dict(), big)
    assert len(big.getvalue()) < 20_000  # bytes; the sequences are 1.6 MB
    for beta, n_envs, seq_len in [([0.0, 1.0], 4, 10), ([0.0, 1.0], 3, 11), ([0.0, 1.1], 3, 10)]:
        with pytest.raises(ValueError, match="noise state of (beta|size)"):
            ColoredNoiseProcess(beta, n_envs, 2, seq_len=seq_len).load_state_dict(state)


def test_on_a_gpu_where_there_is_one():
    device = "cuda" if torch.cuda.is_available() else "cpu"
    x = colored_noise(1, (2000, 1000), generator=torch.Generator(device).manual_seed(0))
    assert x.device.type == device
    psd = torch.fft.rfft(x.double()).abs().square().mean(0).cpu()
    assert torch.allclose(psd, expected_psd(1, 1000), rtol=5 * (2 / 2000) ** 0.5)

    process, other = (ColoredNoiseProcess(0.5, 3, 2, 10, device=device) for _ in range(2))
    process.sample(7)
    other.load_state_dict(process.state_dict())
    assert torch.equal(process.sample(20), other.sample(20))


def test_integers_of_numpy():
    process = ColoredNoiseProcess(0.5, *np.array([2, 3, 10]), seed=np.int64(3))
    plain = ColoredNoiseProcess(0.5, 2, 3, 10, seed=3)
    assert torch.equal(process.sample(np.int64(12)), plain.sample(12))
    assert process.size == (2, 3, 10) and all(type(n) is int for n in process.size)
    assert colored_noise(0.5, np.int64(10)).shape == (10,)
    assert colored_noise(0.5, np.array([2, 10])).shape == (2, 10)


def test_the_default_dtype_does_not_matter():
    plain, closed = draw(0.5, 3, 10), mean_std(0.5, 10)
    torch.set_default_dtype(torch.float64)
    try:
        noise = colored_noise(0.5, (3, 10), generator=torch.Generator().manual_seed(0))
        assert noise.dtype == torch.float32 and torch.equal(noise.double(), plain)
        assert ColoredNoiseProcess(0.5, 2, 3).sample().dtype == torch.float32
        assert mean_std(0.5, 10).dtype == torch.float64 and torch.equal(mean_std(0.5, 10), closed)
    finally:
        torch.set_default_dtype(torch.float32)


def test_projected_beta_solves_the_papers_argument():
    best = published("best_beta_per_n_envs").set_index("n_envs").best_beta
    assert best.to_dict() == PUBLISHED_BEST_BETA
    star = np.mean([mean_std(beta, 1000).item() / n**0.5 for n, beta in best.items()])
    betas = [projected_beta(n) for n in best.index]
    for n, beta in zip(best.index, betas, strict=True):
        assert mean_std(beta, 1000).item() / n**0.5 == pytest.approx(star, rel=1e-6)
        assert projected_beta(n // 2, 4096) == projected_beta(n) if n > 1 else True
    # the study's beta that is projected to be best is a neighbor of this one, or the nearest
    study = np.array([-1, 0, 0.2, 0.5, 0.75, 1, 1.25, 2])
    firsts = projected_ranks(best, study, list(best.index)).idxmin()
    for first, beta in zip(firsts, betas, strict=True):
        below, above = study[study <= beta].max(), study[study >= beta].min()
        assert first in (below, above)
    assert mean_std(projected_beta(8, seq_len=200), 200).item() / 8**0.5 == pytest.approx(star)


def test_projected_beta_stays_in_the_studys_range():
    assert projected_beta(1, n_steps=1) == -1 and projected_beta(100_000) == 2
    assert np.all(np.diff([projected_beta(n) for n in range(1, 130, 9)]) > 0)
    for sizes in [(0, 2048), (4, 0), (4, -1), (math.nan, 2048)]:
        with pytest.raises(ValueError, match="positive"):
            projected_beta(*sizes)


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

"""Colored noise: Gaussian sequences whose expected power spectral density falls as 1/f^beta.

beta = 0 is white noise, 1 pink, 2 red; beta < 0 favors high frequencies. The generator is the one
of Timmer & Koenig (1995), in the form of the packages `colorednoise` and `pink-noise-rl` that
"Colored Noise in PPO" used (Sec. A3).

For sequences of T values there are rFFT bins k = 0 .. T // 2 with scales s_k = f_k^(-beta/2), and
s_0 = s_1. Each bin gets a complex Gaussian of scale s_k; the inverse rFFT is divided by sigma, the
standard deviation it would have without the DC bin. Then every bin has
E|X_k|^2 = 2 (s_k / sigma)^2, from which the closed forms at the end of this file follow.
"""

import math
import numbers
import operator

import torch


def colored_noise(beta, size, *, generator=None, device=None):
    """Draws independent sequences of 1/f^beta noise.

    Args:
        beta: exponent, a finite number, or an array that broadcasts against size[:-1] (one beta per
            sequence).
        size: shape of the result, time last: (..., T) with T >= 2. An int T is a single sequence.
        generator: torch.Generator on `device`; default is torch's own.
        device: torch device of the result; default is the generator's, or the CPU.

    Returns:
        float32 tensor of shape `size` with mean 0 and variance of about 1 (`marginal_variance`).

    Raises:
        ValueError: beta is not finite, or does not broadcast, or size has a non-positive entry or
            T < 2.
    """
    size = (size,) if isinstance(size, numbers.Integral) else size
    size = tuple(operator.index(n) for n in size)  # of numpy's integers, too
    if any(n < 1 for n in size):
        raise ValueError(f"size must be positive in every dimension, got {size}")
    if device is None:
        device = generator.device if generator is not None else "cpu"
    T = size[-1]
    scale = _bin_scale(beta, T).float().to(device)  # (..., T // 2 + 1)
    try:
        scale = scale.expand(*size[:-1], T // 2 + 1)
    except RuntimeError:
        shape = tuple(scale.shape[:-1])
        raise ValueError(f"beta of shape {shape} does not fit the size {size}") from None

    # (..., T // 2 + 1, real and imaginary)
    options = {"generator": generator, "device": device, "dtype": torch.float32}
    spectrum = torch.randn(*scale.shape, 2, **options)
    spectrum = spectrum * scale.unsqueeze(-1)
    # A real sequence has a real DC bin and, for even T, a real Nyquist bin: all their power goes
    # into the real part.
    for k in [0] if T % 2 else [0, T // 2]:
        spectrum[..., k, 0] *= 2**0.5
        spectrum[..., k, 1] = 0
    return torch.fft.irfft(torch.view_as_complex(spectrum), n=T)


class ColoredNoiseProcess:
    """Returns colored noise step by step.

    Each environment and action dimension has an independent sequence of its own.
    When all values of the sequences are used, new ones are drawn. At the end of an episode they
    continue (Sec. A3).

    Args:
        beta: exponent, a finite number, or one value per action dimension.
        n_envs, action_dim: number of parallel environments and of action dimensions.
        seq_len: T, the length of a sequence in steps.
        seed: seed of the process's own random generator; default is another one every time.
        device: torch device of the noise.
    """

    def __init__(self, beta, n_envs, action_dim, seq_len=1000, seed=None, device="cpu"):
        self.beta = torch.as_tensor(beta, dtype=torch.float64)
        if self.beta.ndim > 1 or (self.beta.ndim == 1 and self.beta.numel() not in (1, action_dim)):
            raise ValueError(
                f"beta needs 1 value, or {action_dim}, one per action dimension: "
                f"got {self.beta.tolist()}"
            )
        self.size = tuple(operator.index(n) for n in (n_envs, action_dim, seq_len))
        self.generator = torch.Generator(device)
        if seed is None:
            self.generator.seed()
        else:
            self.generator.manual_seed(operator.index(seed))
        self._draw()

    def _draw(self):
        self.state_before_draw = self.generator.get_state()
        # (n_envs, action_dim, seq_len)
        noise = colored_noise(self.beta, self.size, generator=self.generator)
        self.buffer = noise.permute(2, 0, 1).contiguous()  # (seq_len, n_envs, action_dim)
        self.index = 0

    def sample(self, n_steps=None):
        """Returns the next values: (n_envs, action_dim), or (n_steps, n_envs, action_dim).

        The second if n_steps is given; raises ValueError if it is negative.
        """
        if n_steps is None:
            return self.sample(1)[0]
        if n_steps < 0:
            raise ValueError(f"n_steps must not be negative, got {n_steps}")
        pieces = [self.buffer[:0]]
        while n_steps > 0:
            if self.index == len(self.buffer):
                self._draw()
            pieces.append(self.buffer[self.index : self.index + n_steps])
            self.index += len(pieces[-1])
            n_steps -= len(pieces[-1])
        return torch.cat(pieces)

    def state_dict(self):
        """Returns all that `load_state_dict` needs to continue with the next value.

        Not the sequences, which may be large, but the generator's state from before their draw.
        """
        beta = self.beta.expand(self.size[1]).tolist()
        state = {"generator": self.state_before_draw, "index": self.index}
        return {"beta": beta, "size": self.size, **state}

    def load_state_dict(self, state):
        """Restores a state of a process of the same beta and sizes; raises ValueError otherwise."""
        for name, value in self.state_dict().items():
            if name in ("beta", "size") and list(value) != list(state[name]):
                raise ValueError(f"noise state of {name} {state[name]}, need {value}")
        self.generator.set_state(state["generator"].cpu())
        self._draw()
        self.index = state["index"]


# Closed forms. beta is a number or an array of shape (...); results are float64 tensors with (...)
# in front.


def expected_psd(beta, T):
    """Expected power spectral density E|rfft(x)_k|^2 of a sequence of T values.

    Its shape is (..., T // 2 + 1). Bin k stands for the frequency k / T in cycles per step; it
    falls as f^-beta, and the DC bin equals the first.
    """
    return 2 * _bin_scale(beta, T) ** 2


def autocovariance(beta, T):
    """E[x_t x_(t+h)] for the lags h = 0 .. T - 1: shape (..., T).

    It is circular, since the sequence is periodic.
    """
    return torch.fft.irfft(expected_psd(beta, T), n=T) / T


def marginal_variance(beta, T):
    """Var[x_t], the same at every step t.

    A little over 1, as sigma leaves out the DC bin: 1.0737 at beta 1, T 1000.
    """
    return autocovariance(beta, T)[..., 0]


def mean_std(beta, T):
    """Standard deviation of the mean of a sequence, the paper's "bias".

    Its square is the DC bin's share of the variance.
    """
    return expected_psd(beta, T)[..., 0].sqrt() / T


# n_envs: the beta of best performance, averaged over the study's environments (Sec. "Best beta for
# N_envs"; results/published/best_beta_per_n_envs.csv)
PUBLISHED_BEST_BETA = {1: 0.2, 2: 0.5, 4: 0.5, 8: 0.75, 16: 0.75, 32: 0.75, 64: 0.5, 128: 2.0}


def projected_beta(n_envs, n_steps=2048, seq_len=1000):
    """The beta that the paper's argument on the bias proposes for n_envs * n_steps steps a batch.

    Sec. "Why Do Larger beta Work Better for Larger n_envs": a sequence's mean misses 0 by
    sigma(beta) (`mean_std`), and the more sequences a batch pools, the smaller is what is left of
    it. The beta returned solves sigma(beta) / sqrt(n_envs * n_steps / 2048) = sigma*, the average
    of the left side over the study's best betas, found with n_steps 2048 and sequences of 1000.

    Returns a float within the study's range [-1, 2]: its nearer end, if there is no solution in it.
    Raises ValueError for sizes that are not positive.

    A first guess, not a result. The best betas are averages over 16 environments; in single ones
    they range from 0 to 2. Outside of n_envs * n_steps = 2048 to 262,144 it extrapolates. The
    published betas are for n_steps 2048 and seq_len 1000: what other values do is an assumption.
    Where n_steps is less than seq_len, a rollout holds only pieces of sequences, whose means this
    argument does not describe.
    """
    if not min(n_envs, n_steps) > 0:
        raise ValueError(f"need positive n_envs and n_steps, got {n_envs} and {n_steps}")
    published = [mean_std(beta, 1000).item() / n**0.5 for n, beta in PUBLISHED_BEST_BETA.items()]
    target = sum(published) / len(published) * math.sqrt(n_envs * n_steps / 2048)
    low, high = -1.0, 2.0
    for _ in range(50):  # bisection: sigma grows with beta
        middle = (low + high) / 2
        low, high = (middle, high) if mean_std(middle, seq_len) < target else (low, middle)
    return round(high, 9)


def _bin_scale(beta, T):
    """s_k / sigma, the normalized scale of each rFFT bin: float64, shape (..., T // 2 + 1)."""
    beta = torch.as_tensor(beta, dtype=torch.float64)
    if not beta.isfinite().all():
        raise ValueError(f"beta must be finite, got {beta.tolist()}")
    if T < 2:
        raise ValueError(f"a colored sequence needs T >= 2 steps, got {T}")
    log_f = torch.fft.rfftfreq(T, dtype=torch.float64)[1:].log()
    # Dividing by sigma cancels any common factor, so the largest scale may be 1: then no beta
    # overflows.
    beta = beta.unsqueeze(-1)
    largest = torch.where(beta > 0, log_f[0], log_f[-1])
    s = torch.exp(-0.5 * beta * (log_f - largest))  # s_1 .. s_(T // 2)
    w = s.clone()
    w[..., -1] *= (1 + T % 2) / 2
    sigma = 2 / T * w.square().sum(-1, keepdim=True).sqrt()
    return torch.cat([s[..., :1], s], -1) / sigma

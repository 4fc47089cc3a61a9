"""Colored noise: Gaussian sequences whose expected power spectral density falls as 1/f^beta.

beta = 0 is white noise, 1 pink, 2 red; beta < 0 favors high frequencies. The generator is the one of Timmer & Koenig
(1995), in the form of the packages `colorednoise` and `pink-noise-rl` that "Colored Noise in PPO" used (Sec. A3).

For sequences of T values there are rFFT bins k = 0 .. T // 2 with scales s_k = f_k^(-beta/2), and s_0 = s_1. Each bin
gets a complex Gaussian of scale s_k; the inverse rFFT is divided by sigma, the standard deviation it would have without
the DC bin. Then every bin has E|X_k|^2 = 2 (s_k / sigma)^2, from which the closed forms at the end of this file follow.
"""

import torch


def colored_noise(beta, size, *, generator=None, device=None):
    """Draws independent sequences of 1/f^beta noise.

    Args:
        beta: exponent, a finite number, or an array that broadcasts against size[:-1] (one beta per sequence).
        size: shape of the result, time last: (..., T) with T >= 2. An int T is a single sequence.
        generator: torch.Generator on `device`; default is torch's own.
        device: torch device of the result; default is the generator's, or the CPU.

    Returns:
        float32 tensor of shape `size` with mean 0 and a variance of about 1 (see `marginal_variance`).

    Raises:
        ValueError: beta is not finite, or does not broadcast, or size has a non-positive entry or T < 2.
    """
    size = (size,) if isinstance(size, int) else tuple(size)
    if any(n < 1 for n in size):
        raise ValueError(f"size must be positive in every dimension, got {size}")
    if device is None:
        device = generator.device if generator is not None else "cpu"
    T = size[-1]
    scale = _bin_scale(beta, T).float().to(device)  # (..., T // 2 + 1)
    try:
        scale = scale.expand(*size[:-1], T // 2 + 1)
    except RuntimeError:
        raise ValueError(
            f"beta of shape {tuple(scale.shape[:-1])} does not fit the size {size}"
        ) from None

    spectrum = torch.randn(
        *scale.shape, 2, generator=generator, device=device
    )  # (..., T // 2 + 1, real and imaginary)
    spectrum = spectrum * scale.unsqueeze(-1)
    # A real sequence has a real DC bin and, for even T, a real Nyquist bin: all their power goes into the real part.
    for k in [0] if T % 2 else [0, T // 2]:
        spectrum[..., k, 0] *= 2**0.5
        spectrum[..., k, 1] = 0
    return torch.fft.irfft(torch.view_as_complex(spectrum), n=T)


class ColoredNoiseProcess:
    """Hands out colored noise step by step: one independent sequence per environment and action dimension.

    When all values of the sequences are used, all are drawn anew; ends of episodes do not touch them (Sec. A3).

    Args:
        beta: exponent, a finite number, or one value per action dimension.
        n_envs, action_dim: number of parallel environments and of action dimensions.
        seq_len: T, the length of a sequence in steps.
        seed: seed of the process's own random generator.
        device: torch device of the noise.
    """

    def __init__(self, beta, n_envs, action_dim, seq_len=1000, seed=0, device="cpu"):
        self.beta = torch.as_tensor(beta, dtype=torch.float64)
        if self.beta.ndim > 1 or (self.beta.ndim == 1 and self.beta.numel() not in (1, action_dim)):
            raise ValueError(
                f"beta needs 1 value, or {action_dim}, one per action dimension: got {self.beta.tolist()}"
            )
        self.size = (n_envs, action_dim, seq_len)
        self.generator = torch.Generator(device).manual_seed(seed)
        self._draw()

    def _draw(self):
        noise = colored_noise(
            self.beta, self.size, generator=self.generator
        )  # (n_envs, action_dim, seq_len)
        self.buffer = noise.permute(2, 0, 1).contiguous()  # (seq_len, n_envs, action_dim)
        self.index = 0

    def sample(self, n_steps=None):
        """Returns the next values: (n_envs, action_dim), or (n_steps, n_envs, action_dim) where n_steps is given."""
        if n_steps is None:
            return self.sample(1)[0]
        pieces = []
        while n_steps > 0:
            if self.index == len(self.buffer):
                self._draw()
            pieces.append(self.buffer[self.index : self.index + n_steps])
            self.index += len(pieces[-1])
            n_steps -= len(pieces[-1])
        return torch.cat(pieces)

    def state_dict(self):
        """Returns all that `load_state_dict` needs to go on with the very next value."""
        return {"buffer": self.buffer, "index": self.index, "generator": self.generator.get_state()}

    def load_state_dict(self, state):
        """Restores a state of a process of the same beta and sizes; raises ValueError if the sizes differ."""
        if state["buffer"].shape != self.buffer.shape:
            raise ValueError(
                f"noise state of shape {tuple(state['buffer'].shape)}, need {tuple(self.buffer.shape)}"
            )
        self.buffer = state["buffer"].to(self.generator.device)
        self.index = state["index"]
        self.generator.set_state(state["generator"].cpu())


# Closed forms. beta is a number or an array of shape (...); results are float64 tensors with (...) in front.


def expected_psd(beta, T):
    """Expected power spectral density E|rfft(x)_k|^2 of a sequence of T values: shape (..., T // 2 + 1).

    Bin k stands for the frequency k / T in cycles per step; it falls as f^-beta, and the DC bin equals the first.
    """
    return 2 * _bin_scale(beta, T) ** 2


def autocovariance(beta, T):
    """E[x_t x_(t+h)] for the lags h = 0 .. T - 1: shape (..., T). It is circular, since the sequence is periodic."""
    return torch.fft.irfft(expected_psd(beta, T), n=T) / T


def marginal_variance(beta, T):
    """Var[x_t], the same at every step t. A little over 1, as sigma leaves out the DC bin: 1.0737 at beta 1, T 1000."""
    return autocovariance(beta, T)[..., 0]


def mean_std(beta, T):
    """Standard deviation of the mean of a sequence, the paper's "bias": the DC bin's share of the variance."""
    return expected_psd(beta, T)[..., 0].sqrt() / T


def _bin_scale(beta, T):
    """s_k / sigma, the normalized scale of each rFFT bin: float64, shape (..., T // 2 + 1)."""
    beta = torch.as_tensor(beta, dtype=torch.float64)
    if not beta.isfinite().all():
        raise ValueError(f"beta must be finite, got {beta.tolist()}")
    if T < 2:
        raise ValueError(f"a colored sequence needs T >= 2 steps, got {T}")
    log_f = torch.fft.rfftfreq(T, dtype=torch.float64)[1:].log()
    # Dividing by sigma cancels any common factor, so the largest scale may be 1: then no beta overflows.
    beta = beta.unsqueeze(-1)
    s = torch.exp(
        -0.5 * beta * (log_f - torch.where(beta > 0, log_f[0], log_f[-1]))
    )  # s_1 .. s_(T // 2)
    w = s.clone()
    w[..., -1] *= (1 + T % 2) / 2
    sigma = 2 / T * w.square().sum(-1, keepdim=True).sqrt()
    return torch.cat([s[..., :1], s], -1) / sigma

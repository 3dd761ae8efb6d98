"""Kernel dynamical model of a contour sequence (paper, eqs. 6-7): linear dynamics in the feature space of a kernel.

Ralaivola and d'Alche-Buc, "Dynamical modeling with kernels for nonlinear time series prediction", NIPS 2003. The
non-linear series (6) ``x[t+1] = h(x[t]) + u`` becomes the linear-Gaussian one (7) in feature space; the paper prints
``x[1]`` on its right where ``x[t]`` is meant. Scores of kernel PCA are the coordinates there, and kernel ridge
regression leads back from scores to contours.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import nn

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.statespace.linear_gaussian import LinearModel, SmoothedStates, smooth_states

__all__ = ["KernelDynamics"]

_BUFFERS = (
    "vectors", "width", "gram_mean", "axes", "scores", "score_width", "back",
    "step", "offset", "residual", "spread", "share", "outside",
)  # fmt: skip
_NOISE_SHARES = (0.003, 0.03, 0.1, 0.3, 0.6, 0.9)
"""Candidates for the part of the one-step residual that is measurement noise; the likelihood chooses."""


class KernelDynamics(nn.Module):
    """Fit, predict, smooth and judge a sequence of vectors; state in buffers, so ``state_dict`` keeps a fitted model.

    Args:
        kernel: ``rbf`` (width = median distance of the training vectors) or ``linear``.
        n_components: scores kept; fewer where the training data span less.
        ridge: how far the dynamics are drawn towards standing still, relative to what the data say; near 1 for short
            or broken sequences.
        pre_image_ridge: regularisation of the way back from scores to vectors, relative to the kernel's diagonal.

    Example:
        >>> import torch
        >>> angle = 0.3 * torch.arange(60.0)[:, None]
        >>> x = torch.cat([angle.cos(), angle.sin()], 1)
        >>> model = KernelDynamics("linear", n_components=2, ridge=1e-8).fit(x[:40])
        >>> bool((model.predict(20) - x[40:]).abs().max() < 1e-2)
        True
    """

    vectors: Tensor  # (used, dims) vectors learnt from
    width: Tensor  # of the kernel on vectors
    gram_mean: Tensor  # (used + 1) row means of the Gram matrix, and the mean of all
    axes: Tensor  # (used, q) from centred kernel values to scores
    scores: Tensor  # (used, q) of the training vectors
    score_width: Tensor  # of the kernel on scores
    back: Tensor  # (used, dims) weights of the pre-image
    step: Tensor  # (q, q) and
    offset: Tensor  # (q): z[t+1] = step z[t] + offset
    residual: Tensor  # (q, q) covariance of that
    spread: Tensor  # (q, q) of the scores over time
    share: Tensor  # of the residual that is noise of the measurement
    outside: Tensor  # mean squared distance in feature space from the span of the scores

    def __init__(
        self,
        kernel: Literal["rbf", "linear"] = "rbf",
        n_components: int = 8,
        ridge: float = 1e-3,
        pre_image_ridge: float = 1e-3,
    ) -> None:
        super().__init__()
        if kernel not in ("rbf", "linear"):
            raise ReconError(f"kernel: {kernel!r} is neither 'rbf' nor 'linear'")
        if n_components < 1 or not (ridge > 0 and pre_image_ridge > 0):
            raise ReconError(
                f"n_components {n_components} must be at least 1; ridge {ridge}, {pre_image_ridge} positive"
            )
        self.kernel, self.n_components, self.ridge, self.pre_image_ridge = kernel, n_components, ridge, pre_image_ridge
        for name in _BUFFERS:
            self.register_buffer(name, torch.empty(0))

    def fit(self, x: Float[Tensor, "frames dims"], seen: Bool[Tensor, " frames"] | None = None) -> KernelDynamics:
        """Learn from a sequence.

        Args:
            x: one vector a frame, at equal steps of time.
            seen: frames to learn from; the others are not read. Dynamics are learnt from neighbours that are both seen.

        Raises:
            ReconError: fewer than 3 pairs of neighbours, NaN, or vectors that are all equal.
        """
        seen = _checked(x, seen)
        pairs = seen[:-1] & seen[1:]
        if int(pairs.sum()) < 3:
            raise ReconError(f"x: {int(pairs.sum())} pairs of neighbouring frames can be used; 3 are needed")
        self.vectors = x[seen]
        self.width = _median_distance(self.vectors)
        if not self.width > 0:
            raise ReconError("x: all vectors are equal; there is no motion to learn")
        gram = self._kernel(self.vectors, self.vectors, self.width)
        self.gram_mean = torch.cat([gram.mean(0), gram.mean()[None]])
        centred = self._centre(gram)
        values, vectors = (v.flip(-1)[..., : self.n_components] for v in torch.linalg.eigh(centred))
        kept = values > 1e-10 * values[0]
        self.axes = vectors[:, kept] / values[kept].sqrt()
        self.scores = centred @ self.axes
        self.outside = (centred.diagonal() - self.scores.square().sum(1)).mean().clamp_min(1e-9 * values[0])
        self._fit_dynamics(pairs, seen)
        self._fit_pre_image()
        return self

    def _fit_dynamics(self, pairs: Bool[Tensor, " steps"], seen: Bool[Tensor, " frames"]) -> None:
        z = self.scores.new_zeros(len(seen), self.scores.shape[1])
        z[seen] = self.scores
        now, after = z[:-1][pairs], z[1:][pairs]
        middle, target = now.mean(0), after.mean(0)
        moment = (now - middle).mT @ (now - middle)
        # drawn towards standing still, not towards the mean shape; scores differ much in size, each is held back in
        # proportion to its own
        moment = moment + self.ridge * torch.diag(moment.diagonal())
        change = (after - target) - (now - middle)
        self.step = torch.linalg.solve(moment, (now - middle).mT @ change).mT + torch.eye(z.shape[1]).to(z)
        self.offset = target - self.step @ middle
        error = after - now @ self.step.mT - self.offset
        size = self.scores.square().mean(0)
        self.residual = error.mT @ error / len(error) + torch.diag(1e-9 * size + 1e-12 * size.max())
        self.spread = self.scores.mT @ self.scores / len(self.scores)
        likely = [self._smooth(z, seen, share)[0].log_likelihood for share in _NOISE_SHARES]
        self.share = z.new_tensor(_NOISE_SHARES[likely.index(max(likely))])

    def _fit_pre_image(self) -> None:
        self.score_width = _median_distance(self.scores)
        gram = self._kernel(self.scores, self.scores, self.score_width)
        gram = gram + self.pre_image_ridge * gram.diagonal().mean() * torch.eye(len(gram)).to(gram)
        self.back = torch.linalg.solve(gram, self.vectors - self.vectors.mean(0))

    def _kernel(self, a: Tensor, b: Tensor, width: Tensor) -> Tensor:
        if self.kernel == "linear":
            return a @ b.mT
        return torch.exp(-torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist").square() / (2 * width**2))

    def _centre(self, gram: Float[Tensor, "frames used"]) -> Float[Tensor, "frames used"]:
        """Kernel values against the training vectors, both sides taken relative to their mean in feature space."""
        return gram - gram.mean(1, keepdim=True) - self.gram_mean[:-1] + self.gram_mean[-1]

    def encode(self, x: Float[Tensor, "frames dims"]) -> Float[Tensor, "frames scores"]:
        """Kernel principal component scores of vectors."""
        self._check_fitted()
        return self._centre(self._kernel(x, self.vectors, self.width)) @ self.axes

    def decode(self, z: Float[Tensor, "frames scores"]) -> Float[Tensor, "frames dims"]:
        """Vectors of which given scores are the image, by kernel ridge regression."""
        self._check_fitted()
        return self._kernel(z, self.scores, self.score_width) @ self.back + self.vectors.mean(0)

    def predict(self, n: int) -> Float[Tensor, "steps dims"]:
        """The ``n`` vectors that follow the last one learnt from."""
        self._check_fitted()
        z, out = self.scores[-1], []
        for _ in range(n):
            z = self.step @ z + self.offset
            out.append(z)
        return self.decode(torch.stack(out)) if out else self.vectors[:0]

    def smooth(
        self, x: Float[Tensor, "frames dims"], seen: Bool[Tensor, " frames"] | None = None
    ) -> Float[Tensor, "frames dims"]:
        """The sequence as model and data together see it; frames that are not seen are filled from both sides.

        Args:
            x: one vector a frame, the time step that of the training sequence.
            seen: frames to trust; the others are not read.
        """
        seen = _checked(x, seen)
        z = self.encode(torch.where(seen[:, None], x, self.vectors.mean(0)))
        return self.decode(self._smooth(z, seen)[0].mean)

    def novelty(self, x: Float[Tensor, "frames dims"]) -> Float[Tensor, " frames"]:
        """How badly each frame follows from the one before: squared Mahalanobis length of the one-step innovation.

        A bad frame makes its successor look bad, too; so the innovation over two steps, from the frame before the last
        one, counts where it is smaller. What a vector has outside the span of the scores counts by its mean in
        training. Frame 0 follows nothing and is compared with the spread of the training scores.
        """
        z = self.encode(x)
        error = z[1:] - z[:-1] @ self.step.mT - self.offset
        rest = _squared_length(error, self.residual)
        ahead = error[1:] + error[:-1] @ self.step.mT
        both = _squared_length(ahead, self.residual + self.step @ self.residual @ self.step.mT)
        rest = torch.cat([rest[:1], torch.minimum(rest[1:], both)])
        return torch.cat([_squared_length(z[:1], self.spread), rest]) + self._outside(x, z)

    def deviation(
        self, x: Float[Tensor, "frames dims"], seen: Bool[Tensor, " frames"] | None = None
    ) -> Float[Tensor, " frames"]:
        """How badly each frame fits to all *other* seen frames: squared Mahalanobis length of the leave-one-out error.

        Args:
            x: finite in every frame that is to be judged; NaN frames give NaN.
            seen: frames that take part in judging the others.
        """
        seen = _checked(x, seen)
        z = self.encode(x)
        states, noise = self._smooth(z, seen)
        error = z - states.mean
        # a seen frame pulls the smoothed state towards itself; taking it out again is one division
        spread = torch.where(seen[:, None, None], noise - states.covariance, noise + states.covariance)
        return (error * torch.linalg.solve(spread, error[..., None])[..., 0]).sum(1) + self._outside(x, z)

    def _outside(self, x: Tensor, z: Tensor) -> Tensor:
        own = x.square().sum(1) if self.kernel == "linear" else x.new_ones(len(x))
        centred = own - 2 * self._kernel(x, self.vectors, self.width).mean(1) + self.gram_mean[-1]
        return (centred - z.square().sum(1)).clamp_min(0) / self.outside

    def _smooth(self, z: Tensor, seen: Tensor, share: float | None = None) -> tuple[SmoothedStates, Tensor]:
        """Smoothed scores and the covariance of a measurement."""
        share = float(self.share) if share is None else share
        # in units of their own spread the scores are alike in size, which keeps the covariances well conditioned
        size = self.spread.diagonal().sqrt()
        both = size[:, None] * size
        noise = share * self.residual
        model = LinearModel(
            self.step * size / size[:, None], self.offset / size, (self.residual - noise) / both, noise / both,
            torch.zeros_like(size), self.spread / both,
        )  # fmt: skip
        states = smooth_states(z / size, seen, model)
        return SmoothedStates(states.mean * size, states.covariance * both, states.log_likelihood), noise

    def _check_fitted(self) -> None:
        if not self.vectors.numel():
            raise ReconError("KernelDynamics: call fit first")

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        # the shapes are those of what was learnt
        for name in _BUFFERS:
            if prefix + name in state_dict:
                setattr(self, name, torch.empty_like(state_dict[prefix + name]))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def _checked(x: Float[Tensor, "frames dims"], seen: Bool[Tensor, " frames"] | None) -> Bool[Tensor, " frames"]:
    seen = torch.ones(len(x), dtype=torch.bool, device=x.device) if seen is None else seen
    bad = seen & ~torch.isfinite(x).all(1)
    if bad.any():
        raise ReconError(f"x: frame {int(bad.nonzero()[0])} is marked as seen and holds NaN or infinite values")
    return seen


def _squared_length(
    error: Float[Tensor, "n scores"], covariance: Float[Tensor, "scores scores"]
) -> Float[Tensor, " n"]:
    """Squared Mahalanobis lengths."""
    return (error * torch.linalg.solve(covariance, error.mT).mT).sum(1)


def _median_distance(x: Float[Tensor, "frames dims"]) -> Tensor:
    return torch.pdist(x).median()

"""Reverse mode through the steps of a training's optimiser.

The implicit adjoint assumes a stationary point, which a dozen epochs do not reach. Let lambda_t be the derivative of
L_val by the state before step t (theta and the optimiser's moments). Going back one step computes

    a_t       lambda_{t+1}, pulled back through the step onto its batch's gradient,
    lambda_t  lambda_{t+1}, pulled back through the step onto its state, plus ``H_t a_t`` in theta,

where H_t is the Hessian of the step's objective at theta_t. An image of weight w in that objective has
``dL_val/dw = <dl/dtheta, a_t>``. This score, summed over the steps, takes the place of ``-<dl/dtheta, v>``, minus sign
included (Baydin and Pearlmutter 2014; Maclaurin et al. 2015; here states are stored, not recomputed backwards).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, Protocol, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.detector.trajectory import Trajectory, pulled_back
from neural_sim.gradient.base import Params
from neural_sim.solver.operator import flatten, plain_norm, unflatten

Product = Literal["forward_difference", "central_difference", "reverse_over_reverse"]
Wanted = Literal["probes", "weights", "inputs"]
"""Which sums an estimator reads: ``probes``: the probes' scores only; ``weights``: also derivatives with respect to the
training images' weights; ``inputs``: also those with respect to the images' inputs."""
InputsOf = Callable[[Tensor, Tensor], tuple[Tensor, ...]]
"""Computes a training's inputs from images and their rows."""


class LossesFrom(Protocol):
    """Losses of training images, twice differentiable in parameters and inputs."""

    def __call__(
        self, params: Params, inputs: tuple[Tensor, ...], rows: Int[Tensor, "n"], /
    ) -> Float[Tensor, "n"]:
        """Compute the losses of ``rows`` from their inputs."""
        ...


@dataclass(frozen=True)
class Examples:
    """A training's examples and their losses.

    Each step's objective is its batch's mean loss plus ``proximal / 2 |theta - anchor|^2``.

    Attributes:
        inputs: what losses are computed from, tensors [N, ...]; where images change with psi, losses are differentiated
            by them.
        losses: computes losses of rows from their inputs.
        proximal: weight of the proximal term.
        anchor: the fixed theta_0 of the proximal term.
        inputs_of: computes the inputs from images and their rows.
        drawn: how many rows were drawn from p_psi. They come first; the others are photographs, which do not depend on
            psi. None: all rows.

    Raises:
        ValueError: a proximal term that is negative or lacks its anchor.
    """

    inputs: tuple[Tensor, ...]
    losses: LossesFrom
    proximal: float = 0.0
    anchor: Params | None = None
    inputs_of: InputsOf | None = None
    drawn: int | None = None

    def __post_init__(self) -> None:
        if self.proximal < 0.0 or (self.proximal > 0.0 and self.anchor is None):
            raise ValueError(
                f"unrolled: proximal must be at least 0 and wants its anchor, got {self.proximal}, "
                f"{'no anchor' if self.anchor is None else 'an anchor'}"
            )

    def of(self, rows: Int[Tensor, "n"]) -> tuple[Tensor, ...]:
        """Select rows of the inputs."""
        return tuple(values[rows] for values in self.inputs)

    def drawn_part(self, rows: Int[Tensor, "batch"]) -> Tensor | float:
        """Return the fraction of a batch that was drawn from p_psi."""
        return 1.0 if self.drawn is None else (rows < self.drawn).double().mean()

    def gradient(
        self, theta: Float[Tensor, "n"], like: Params, rows: Int[Tensor, "batch"]
    ) -> Float[Tensor, "n"]:
        """Compute the gradient of one step's objective."""
        point = theta.detach().requires_grad_()
        with torch.enable_grad():
            loss = self.losses(unflatten(point, like), self.of(rows), rows).mean()
        (slope,) = torch.autograd.grad(loss, point)
        return slope + self.proximal_gradient(theta, like)

    def proximal_gradient(self, theta: Float[Tensor, "n"], like: Params) -> Float[Tensor, "n"] | float:
        """Compute the proximal term's gradient."""
        if self.anchor is None or self.proximal == 0.0:
            return 0.0
        return self.proximal * (theta - flatten({name: self.anchor[name] for name in like}))


@dataclass(frozen=True)
class RecordedTraining:
    """A training with all that is needed to reverse it.

    Attributes:
        trajectory: the recorded steps.
        examples: the training set.
        params: theta after the last step.
    """

    trajectory: Trajectory
    examples: Examples
    params: Params

    @property
    def steps(self) -> int:
        """The number of steps."""
        return len(self.trajectory)


@dataclass(frozen=True)
class ReversedStep:
    """One reversed step.

    Attributes:
        params: theta before the step.
        along: a_t.
        rows: the rows of its batch.
        scores: <dl/dtheta, a_t> of the batch's images; may be empty if only probes are wanted.
        inputs: derivative of the mean score by the inputs of these rows; empty unless wanted.
    """

    params: Params
    along: Params
    rows: Int[Tensor, "batch"]
    scores: Float[Tensor, "_"]
    inputs: tuple[Tensor, ...]


@dataclass(frozen=True)
class _Curved:
    """A batch's curvature along a_t: ``product`` is ``H_t a_t``; the other fields are as in ``ReversedStep``."""

    product: Float[Tensor, "n"]
    scores: Float[Tensor, "_"]
    inputs: tuple[Tensor, ...]


def reversed_steps(
    training: RecordedTraining,
    slope: Float[Tensor, "n"],
    product: Product = "central_difference",
    wanted: Wanted = "weights",
    floor: float = 0.0,
) -> Iterator[ReversedStep]:
    """Walk back through the steps of a training, from the last to the first.

    Args:
        training: the training.
        slope: ``dL_val/dtheta`` after its last step.
        product: how a batch's Hessian is multiplied. ``forward_difference``: the gradient at ``theta + h a`` minus the
            step's recorded gradient, with relative error eps^(1/2), if only probes are wanted (otherwise like
            ``central_difference``). ``central_difference``: two gradients, at ``theta +- h a``, with relative error
            eps^(2/3). ``reverse_over_reverse``: exact, in the time of three and a half gradients and with the memory of
            a second derivative.
        wanted: which sums the estimator reads.
        floor: the fraction passed to ``detector.trajectory.AdamW.floored``; at 0 the derivative is exact.

    Raises:
        ValueError: an unknown product, or a slope that does not have theta's length.
    """
    trajectory, examples, like = training.trajectory, training.examples, training.params
    if product not in get_args(Product):
        raise ValueError(f"outer.adjoint.product must be one of {get_args(Product)}, got {product!r}")
    if slope.shape != trajectory.end.shape:
        raise ValueError(
            f"unrolled: got a slope of shape {tuple(slope.shape)}, want {tuple(trajectory.end.shape)}"
        )
    one_sided = product == "forward_difference" and wanted == "probes"
    curved = _doubly_reversed if product == "reverse_over_reverse" else _differenced
    rule = trajectory.rule
    cotangents = list(rule.begin(slope))  # L_val does not depend on the buffers after the last step
    for segment in trajectory.segments():
        replayed = trajectory.replayed(segment, lambda theta, rows: examples.gradient(theta, like, rows))
        for step in reversed(segment):
            state, gradient = replayed.pop()
            rate = trajectory.rates[step]
            if step + 1 == len(trajectory):
                sizes = [part.numel() for part in like.values()]
                rule = rule.floored(rule.step(state, gradient, rate, step), len(trajectory), floor, sizes)
            cotangents, along = pulled_back(rule, state, gradient, rate, step, cotangents)
            rows = trajectory.rows[step]
            if one_sided:
                of_batch = gradient - examples.proximal_gradient(state[0], like)
                curvature = _from_one_side(examples, state[0], like, rows, along, of_batch)
            else:
                curvature = curved(examples, state[0], like, rows, along, wanted == "inputs")
            cotangents[0] = cotangents[0] + curvature.product + examples.proximal * along
            yield ReversedStep(
                unflatten(state[0], like), unflatten(along, like), rows, curvature.scores, curvature.inputs
            )


def _doubly_reversed(
    examples: Examples, theta: Tensor, like: Params, rows: Tensor, along: Tensor, with_inputs: bool
) -> _Curved:
    """Differentiate <gradient, a> once more, by theta, the images' weights and their inputs at once."""
    point = theta.detach().requires_grad_()
    weights = theta.new_full((len(rows),), 1.0 / len(rows)).requires_grad_()
    inputs = tuple(values.detach().requires_grad_(with_inputs) for values in examples.of(rows))
    with torch.enable_grad():
        loss = examples.losses(unflatten(point, like), inputs, rows) @ weights
        (slope,) = torch.autograd.grad(loss, point, create_graph=True)
    leaves = (point, weights, *(inputs if with_inputs else ()))
    product, scores, *moved = torch.autograd.grad(slope, leaves, along, materialize_grads=True)
    return _Curved(product, scores, tuple(moved))


def _differenced(
    examples: Examples, theta: Tensor, like: Params, rows: Tensor, along: Tensor, with_inputs: bool
) -> _Curved:
    """Take central differences of losses and gradients, without waiting for the device."""
    unit, scale = _displacement(theta, along, torch.finfo(theta.dtype).eps ** (1 / 3))
    inputs = tuple(values.detach().requires_grad_(with_inputs) for values in examples.of(rows))
    sides: list[tuple[Tensor, ...]] = []
    for point in (theta + unit, theta - unit):
        leaf = point.detach().requires_grad_()
        with torch.enable_grad():
            losses = examples.losses(unflatten(leaf, like), inputs, rows)
            loss = losses.mean()
        leaves = (leaf, *(inputs if with_inputs else ()))
        sides.append((losses.detach(), *torch.autograd.grad(loss, leaves, materialize_grads=True)))
    scores, product, *moved = ((above - below) * (0.5 * scale) for above, below in zip(*sides, strict=True))
    return _Curved(product, scores, tuple(moved))


def _from_one_side(
    examples: Examples, theta: Tensor, like: Params, rows: Tensor, along: Tensor, at_theta: Tensor
) -> _Curved:
    """Take the forward difference of gradients; ``at_theta`` is the gradient of the batch's mean loss at theta."""
    # Rounding and third derivatives contribute about equally at eight times the root of eps.
    unit, scale = _displacement(theta, along, 8 * torch.finfo(theta.dtype).eps ** 0.5)
    leaf = (theta + unit).detach().requires_grad_()
    with torch.enable_grad():
        loss = examples.losses(unflatten(leaf, like), examples.of(rows), rows).mean()
    (ahead,) = torch.autograd.grad(loss, leaf)
    return _Curved((ahead - at_theta) * scale, theta.new_zeros(0), ())


def _displacement(theta: Tensor, along: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """Return the vector h a, of length ``reach`` times (1 + RMS of theta), and 1 / h, without waiting for the device.

    If a is 0, h a is 0 as well, so that differences along it vanish.
    """
    size = plain_norm(along).clamp_min(torch.finfo(torch.float64).tiny)
    length = reach * (1.0 + plain_norm(theta) / theta.numel() ** 0.5)
    return (along.double() / size).to(theta) * length.to(theta), (size / length).to(theta)

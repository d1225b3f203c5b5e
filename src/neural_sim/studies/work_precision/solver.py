"""The inverse-Hessian product by every solver, damping and product mode, compared with dense references.

The detector is small enough for a dense Hessian, and trained on two objects.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.detector.training import Optimisation, train_detector
from neural_sim.field.grid import GridField
from neural_sim.gradient.base import Params
from neural_sim.gradient.estimators import importance_weights
from neural_sim.gradient.implicit import InnerProblem
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.ranges import Positive, PositiveInt, validated
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.base import Solution
from neural_sim.solver.damping import FixedDamping
from neural_sim.solver.direct import Exact
from neural_sim.solver.hvp import HessianOperator, Term, gradient
from neural_sim.studies.work_precision.measurement import Point, Series, Timing, World
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import FieldSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.types import LabelledImages, PinholeCamera

# --- the detector with a dense Hessian ---

BINS = 4
PSI = torch.tensor([[0.0, 1.0, 0.0, -0.5], [0.5, 0.0, 1.5, 0.0]], dtype=torch.float64)
SIZE = 32


def small_scene() -> Scene:
    """Make a scene of two textured blocks in front of clutter, at 32 pixels."""

    def block(seed: int) -> GridField:
        field = GridField().eval()
        field.reset(torch.ones(4, 4, 4, dtype=torch.bool), torch.full((3,), -0.6), 0.3)
        noise = torch.randn(field.table.shape, generator=torch.Generator().manual_seed(seed))
        with torch.no_grad():
            field.table.copy_(noise + 1.0)
        return field.requires_grad_(False)

    camera = PinholeCamera(SIZE, SIZE, math.radians(40.0))
    synthesizer = Synthesizer(ProceduralClutter(), shift=0.1)
    distribution = SceneDistribution.of([Pose(bins=BINS)])
    subjects = tuple(FieldSubject(name, block(seed), NerfRenderer()) for name, seed in (("a", 1), ("b", 2)))
    return Scene(subjects, camera, synthesizer, distribution)


def trained_problem(make: Callable[..., Detector], images: int = 40) -> tuple[InnerProblem, list[Term]]:
    """Train a detector on ``images`` of each object; return its inner problem and L_val.

    The inner problem has one image per bin and object, weighted by the probability of the bin divided by the number of
    objects. Both are in float64.
    """
    generator, scene = torch.Generator().manual_seed(0), small_scene()
    detector = make(num_classes=2, image_size=SIZE)
    drawn = scene.training_set(PSI, images, generator).images
    validation = scene.training_set(PSI.flip(-1), 8, generator).images
    probes = [scene.probes(label, "pose", 1, PSI, generator)[0] for label in range(2)]
    params, _ = train_detector(
        detector, detector.init(generator), drawn, generator,
        Optimisation(40, batch_size=16, learning_rate=1e-2, weight_decay=1e-2),
    )  # fmt: skip
    backbone, warm = detector.split(params)
    held = CachedSet.of(detector, backbone, LabelledImages.concatenate(probes)).double()
    factor = scene.distribution.binned[0]
    p = [factor.log_probabilities(psi).exp() for psi in PSI]
    weights = torch.cat([importance_weights(each, torch.arange(BINS), 0.5) for each in p])
    problem = InnerProblem(as_double(warm), held.losses, weights)
    return problem, CachedSet.of(detector, backbone, validation).double().mean_terms()


def as_double(params: Params) -> Params:
    """Return the parameters in float64."""
    return {name: value.double() for name, value in params.items()}


# --- the family ---

UNKNOWNS = 200
"""Size of the linear systems with a given condition number."""
TIGHT = 1e-12
"""Tolerance of solves with a given number of steps, small enough never to end them early."""


@dataclass(frozen=True)
class Product:
    """How a Hessian product is computed; the fields of ``AdjointSolver``."""

    mode: str
    retain_graph: bool

    def of(self, solver: AdjointSolver) -> AdjointSolver:
        """Return the solver with this kind of product."""
        return replace(solver, mode=self.mode, retain_graph=self.retain_graph)


PRODUCTS = {
    "graph kept": Product("reverse_over_reverse", True),
    "graph built anew": Product("reverse_over_reverse", False),
    "central differences": Product("central_difference", False),
}


@dataclass(frozen=True)
class Setting:
    """A solver in a table, its line in the figure, and whether it is the default."""

    name: str
    line: str
    solver: AdjointSolver
    default: bool = False


@dataclass(frozen=True)
class Oracle:
    """Eigenvalues (growing) and eigenvectors of the dense Hessian, and the right-hand side in their basis."""

    values: Float[Tensor, "n"]
    vectors: Float[Tensor, "n n"]
    coefficients: Float[Tensor, "n"]

    @staticmethod
    def of(terms: Sequence[Term], params: Parameters, b: Float[Tensor, "n"]) -> Oracle:
        """Decompose the dense Hessian of the terms."""
        matrix = HessianOperator(terms, params, retain_graph=True).dense()
        values, vectors = torch.linalg.eigh(0.5 * matrix + 0.5 * matrix.T)
        return Oracle(values, vectors, vectors.T @ b)

    def solve(self, damping: float) -> Float[Tensor, "n"]:
        """Return (H + damping I)^-1 b; its relative error is about n eps times the condition number."""
        return self.vectors @ (self.coefficients / (self.values + damping))


@dataclass(frozen=True)
class Inverse:
    """(H + lambda I)^-1 dL_val/dtheta for a detector small enough for a dense reference solution."""

    terms: Sequence[Term]
    params: Parameters
    b: Float[Tensor, "n"]
    oracle: Oracle
    seconds: float
    """Time that the eigenvalues of the dense reference took."""
    timing: Timing
    seed: int

    @staticmethod
    def of(problem: InnerProblem, validation: list[Term], timing: Timing, seed: int) -> Inverse:
        """Decompose the Hessian of a problem, for the gradient of ``validation``."""
        params, terms = problem.params, problem.terms()
        b = gradient(validation, params)
        spent, oracle = timing.once(lambda: Oracle.of(terms, params, b))
        return Inverse(terms, params, b, oracle, spent, timing, seed)

    def chosen(self, solver: AdjointSolver) -> float:
        """Return the damping that a solver chooses itself."""
        random = torch.Generator().manual_seed(self.seed)
        return solver.damping.choose(solver.operator(self.terms, self.params), self.b, random).value

    def series(self, name: str, settings: Sequence[Setting], damping: float, more: str) -> Series:
        """Solve with every setting, and compare with the dense solution at the same damping."""
        truth = self.oracle.solve(damping)
        points = tuple(self._point(setting, truth) for setting in settings)
        low, high = (float(self.oracle.values[place]) + damping for place in (0, -1))
        condition = high / low if low > 0.0 else math.inf
        note = (
            f"(H + lambda I)^-1 dL_val/dtheta of a detector of {self.b.numel()} trained numbers after its training, "
            f"float64, lambda = {damping:.3g} (eigenvalues {low:.2g} to {high:.3g}, condition {condition:.3g}); "
            f"against the dense matrix, whose eigenvalues take {self.seconds:.3g} s.{more}"
        )
        return Series(f"solver/{name}", "relative error of the product", points, (), note, self.timing.clock)

    def _point(self, setting: Setting, truth: Tensor) -> Point:
        def solve():
            generator = torch.Generator().manual_seed(self.seed)
            return setting.solver.solve(self.terms, self.params, self.b, None, generator)

        found = solve()
        spectrum = found.damping.spectrum
        products = found.solution.products + (spectrum.products if spectrum else 0)
        seconds, memory = self.timing.of(solve)
        detail = f"{products} products, {_words(found.solution)}"
        if found.damping_raises:  # it solved a different system from the reference
            detail += f", lambda raised to {found.damping.value:.3g}"
        error = relative(found.solution.value, truth)
        return Point(setting.name, error, seconds, memory, setting.default, setting.line, detail)


def _words(solution: Solution) -> str:
    return solution.status.name.lower().replace("_", " ")


@validated
@dataclass(frozen=True)
class Solver:
    """The family ``solver``.

    Args:
        solvers: solvers by name; the dense one is the reference and not among them.
        detector: makes the detector of the solves, small enough for a dense Hessian.
        timed: makes the detector whose Hessian products are timed.
        default: the default among ``solvers``.
        rtols: relative residuals of solves that choose their own damping, in addition to the configured one.
        steps: numbers of steps of solves with a given damping.
        factors: multiples of the damping that the default chooses; one series each.
        conditions: condition numbers of linear systems; one series each.
        images: number of images for ``timed``, at ``size`` pixels a side.

    Raises:
        ValueError: the default is unknown.
    """

    solvers: Mapping[str, AdjointSolver] = field(default_factory=lambda: {"cg": AdjointSolver()})
    detector: Callable[..., Detector] | None = None
    timed: Callable[..., Detector] | None = None
    default: str = "cg"
    rtols: tuple[Positive, ...] = (1e-6, 1e-9)
    steps: tuple[PositiveInt, ...] = (5, 10, 20, 40)
    factors: tuple[Positive, ...] = (1.0, 0.75)
    conditions: tuple[Positive, ...] = (1e2, 1e6, 1e10)
    images: PositiveInt = 64
    size: PositiveInt = 96

    def __post_init__(self) -> None:
        if self.default not in self.solvers:
            raise ValueError(
                f"work_precision.solver.default must be one of {', '.join(self.solvers)}, got {self.default!r}"
            )

    def measure(self, world: World, timing: Timing, seed: int) -> Iterator[Series]:
        """Measure on the detector of ``micro``, on linear systems, and products of the run's kind of detector."""
        del world  # this family has its own problems
        if self.detector is not None:
            yield from self._inverse(Inverse.of(*trained_problem(self.detector), timing, seed))
        for condition in self.conditions:
            yield self._system(condition, timing, seed)
        if self.timed is not None:
            yield self._products(self.timed, timing, seed)

    def _inverse(self, problem: Inverse) -> Iterator[Series]:
        chosen = problem.chosen(self.solvers[self.default])
        more = " Each chooses its lambda itself, from products that count; a solve starts from these."
        yield problem.series("damping of its own", list(self._own()), chosen, more)
        for factor in self.factors:
            value = factor * chosen
            more = f" This lambda, {factor:g} times what the default chooses, is given; no product is spent on it."
            yield problem.series(f"lambda {value:.3g} given", list(self._given(value)), value, more)

    def _given(self, value: float) -> Iterator[Setting]:
        """Yield solvers by number of steps, at a given lambda."""
        fixed = FixedDamping(value, 0)
        for name, solver in self.solvers.items():
            once = name == "identity"  # takes no steps
            for steps in self.steps[:1] if once else self.steps:
                asked = replace(solver, damping=fixed, rtol=TIGHT, max_steps=steps, max_raises=0)
                yield Setting(name if once else f"{name}, {steps} steps", name, asked)

    def _own(self) -> Iterator[Setting]:
        """Yield solvers by tolerance, each with its own damping, and the default with other Hessian products."""
        own = self.solvers[self.default]
        others = {
            f"{self.default}, {how}": product.of(own)
            for how, product in PRODUCTS.items()
            if product.of(own) != own
        }
        for name, solver in {**self.solvers, **others}.items():
            if name == "identity":
                yield Setting(name, name, solver)
                continue
            for rtol in sorted({*self.rtols, solver.rtol}, reverse=True):
                default = name == self.default and rtol == solver.rtol
                yield Setting(f"{name}, rtol {rtol:g}", name, replace(solver, rtol=rtol), default)

    def _system(self, condition: float, timing: Timing, seed: int) -> Series:
        """Solve systems with log-spaced eigenvalues from 1 to 1 / condition, constructed from a known solution."""
        generator = torch.Generator().manual_seed(seed)
        basis, _ = torch.linalg.qr(torch.randn(UNKNOWNS, UNKNOWNS, generator=generator, dtype=torch.float64))
        truth = torch.randn(UNKNOWNS, generator=generator, dtype=torch.float64)
        values = torch.logspace(0.0, -math.log10(condition), UNKNOWNS, dtype=torch.float64)
        matrix = basis * values @ basis.T
        matrix = 0.5 * (matrix + matrix.T)
        b, points = matrix @ truth, []
        for name, solver in {**self.solvers, "dense": AdjointSolver(Exact())}.items():
            for rtol in (1e-2, 1e-6, 1e-10) if name not in ("dense", "identity") else (1e-10,):

                def solve(linear=solver.linear, rtol: float = rtol):
                    return linear.solve(matrix.mv, b, rtol=rtol, max_steps=10 * UNKNOWNS)

                found = solve()
                seconds, memory = timing.of(solve)
                detail = f"{found.products} products, {_words(found)}"
                setting = name if name in ("dense", "identity") else f"{name}, rtol {rtol:g}"
                points.append(
                    Point(setting, relative(found.value, truth), seconds, memory, False, name, detail)
                )
        note = (
            f"{UNKNOWNS} unknowns, float64, eigenvalues spread evenly in log from 1 to {1.0 / condition:.0e}; an rtol "
            "allows an error of rtol times the condition number."
        )
        name = f"solver/condition {condition:.0e}"
        return Series(name, "relative error of the solution", tuple(points), (), note, timing.clock)

    def _products(self, make: Callable[..., Detector], timing: Timing, seed: int) -> Series:
        """Multiply by the Hessian on cached features in float32, against the exact product in float64."""
        terms, params, precise = product_problem(make, self.images, self.size, seed)
        vector = gradient(terms, params)
        truth = HessianOperator(precise, as_double(params))(vector.double())
        plain, _ = timing.of(lambda: gradient(terms, params))
        points, default = [], self.solvers[self.default]
        for name, how in PRODUCTS.items():
            operator = HessianOperator(terms, params, how.mode, how.retain_graph)  # pyright: ignore[reportArgumentType]
            seconds, memory = timing.of(lambda operator=operator: operator(vector))
            error, own = relative(operator(vector).double(), truth), how.of(default) == default
            points.append(
                Point(name, error, seconds, memory, own, "products", f"{seconds / plain:.1f} gradients")
            )
        note = (
            f"A Hessian product on {self.images} images of {self.size} px with cached features, {vector.numel()} "
            "trained numbers, float32, against float64. A kept graph takes one gradient with its graph beforehand, "
            "and the memory of all images as long as it is kept, which MB does not count."
        )
        return Series(
            "solver/one product", "relative error of the product", tuple(points), (), note, timing.clock
        )


def relative(value: Float[Tensor, "n"], truth: Float[Tensor, "n"]) -> float:
    """Return |value - truth| / |truth|."""
    return float((value - truth).norm() / truth.norm())


def product_problem(
    make: Callable[..., Detector], images: int, size: int, seed: int
) -> tuple[list[Term], Parameters, list[Term]]:
    """Return loss terms of an untrained detector on random pictures of a box, its parameters, and float64 terms."""
    generator, detector = torch.Generator().manual_seed(seed), make(num_classes=6, image_size=size)
    backbone, params = detector.split(detector.init(generator))
    corner = 0.5 * size * torch.rand(images, 1, 2, generator=generator)
    side = size * (0.2 + 0.25 * torch.rand(images, 1, 2, generator=generator))
    drawn = LabelledImages(
        torch.rand(images, 3, size, size, generator=generator), torch.cat([corner, corner + side], -1),
        torch.randint(0, 6, (images, 1), generator=generator), torch.zeros(images, dtype=torch.long),
    )  # fmt: skip
    held = CachedSet.of(detector, backbone, drawn)
    weights = torch.full((images,), 1.0 / images)
    double = held.double()
    terms = InnerProblem(params, held.losses, weights).terms()
    return terms, params, InnerProblem(as_double(params), double.losses, weights.double()).terms()

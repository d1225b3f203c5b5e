"""The inverse-Hessian product by every solver, damping and product mode, compared with dense references.

It is that of a detector trained on two objects, which is small enough for a dense Hessian.
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
from neural_sim.studies.stress.linear import logarithmic, relative, system
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
    """Train a detector on ``images`` of each object, and return its inner problem and L_val in float64.

    The inner problem has one image per bin and object, weighted by the bin's probability over the number of objects.
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
"""Tolerance of solves with a given number of steps, which is too small to end them early."""


@dataclass(frozen=True)
class Product:
    """How a Hessian product is computed, as fields of ``AdjointSolver``."""

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
    """Ascending eigenvalues and the eigenvectors of the dense Hessian, and the right-hand side in their basis."""

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
    """Seconds that the eigenvalues of the dense Hessian took."""
    timing: Timing
    seed: int

    @staticmethod
    def of(problem: InnerProblem, validation: list[Term], timing: Timing, seed: int) -> Inverse:
        """Decompose the Hessian of a problem; the gradient of ``validation`` is the right-hand side."""
        params, terms = problem.params, problem.terms()
        b = gradient(validation, params)
        spent, oracle = timing.once(lambda: Oracle.of(terms, params, b))
        return Inverse(terms, params, b, oracle, spent, timing, seed)

    def chosen(self, solver: AdjointSolver) -> float:
        """Return the damping that a solver chooses itself."""
        random = torch.Generator().manual_seed(self.seed)
        return solver.damping.choose(solver.operator(self.terms, self.params), self.b, random).value

    def series(self, name: str, settings: Sequence[Setting], damping: float, more: str) -> Series:
        """Solve with every setting, and compare with the dense solution at this damping."""
        points = tuple(self._point(setting, damping) for setting in settings)
        low, high = (float(self.oracle.values[place]) + damping for place in (0, -1))
        condition = high / low if low > 0.0 else math.inf
        note = (
            f"(H + lambda I)^-1 dL_val/dtheta of a trained detector with {self.b.numel()} parameters, in float64, with "
            f"lambda = {damping:.3g} (eigenvalues {low:.2g} to {high:.3g}, condition {condition:.3g}); compared with "
            f"the dense solution, whose eigenvalues take {self.seconds:.3g} s.{more}"
        )
        return Series(f"solver/{name}", "relative error of the product", points, (), note, self.timing.clock)

    def _point(self, setting: Setting, damping: float) -> Point:
        def solve():
            generator = torch.Generator().manual_seed(self.seed)
            return setting.solver.solve(self.terms, self.params, self.b, None, generator)

        found = solve()
        spectrum = found.damping.spectrum
        products = found.solution.products + (spectrum.products if spectrum else 0)
        seconds, memory = self.timing.of(solve)
        detail = f"{products} products, {_words(found.solution)}"
        if not math.isclose(found.damping.value, damping, rel_tol=1e-3):  # it solved another system
            detail += f", at lambda = {found.damping.value:.3g}"
        error = relative(found.solution.value, self.oracle.solve(damping))
        return Point(setting.name, error, seconds, memory, setting.default, setting.line, detail)


def _words(solution: Solution) -> str:
    return solution.status.name.lower().replace("_", " ")


@validated
@dataclass(frozen=True)
class Solver:
    """The family ``solver``.

    Args:
        solvers: solvers by name, without the dense one, which is the reference.
        detector: makes the detector of the solves, small enough for a dense Hessian; null: no solves.
        timed: makes the detector whose Hessian products are timed; null: no products.
        default: the default among ``solvers``.
        rtols: relative residuals of solves that choose their own damping, in addition to the configured one.
        steps: numbers of steps of solves with a given damping.
        factors: the given dampings, as multiples of the one that the default chooses; one series each.
        conditions: condition numbers of linear systems; one series each.
        images: number of images in a Hessian product of ``timed``.
        size: side of these images in pixels.

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
                f"work_precision.solver.default: want one of {', '.join(self.solvers)}, got {self.default!r}"
            )

    def measure(self, world: World, timing: Timing, seed: int) -> Iterator[Series]:
        """Measure solves for ``detector`` and of linear systems, and Hessian products of ``timed``."""
        del world  # this family has its own problems
        if self.detector is not None:
            yield from self._inverse(Inverse.of(*trained_problem(self.detector), timing, seed))
        for condition in self.conditions:
            yield self._system(condition, timing, seed)
        if self.timed is not None:
            yield self._products(self.timed, timing, seed)

    def _inverse(self, problem: Inverse) -> Iterator[Series]:
        chosen = problem.chosen(self.solvers[self.default])
        more = (
            " Each setting chooses its own lambda, from products that count and that the solve starts from."
        )
        yield problem.series("damping of its own", list(self._own()), chosen, more)
        for factor in self.factors:
            value = factor * chosen
            more = f" This lambda is given: {factor:g} times the one that the default chooses, at no cost."
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
        problem = system(logarithmic(condition, UNKNOWNS), torch.Generator().manual_seed(seed))
        points = []
        for name, solver in {**self.solvers, "dense": AdjointSolver(Exact())}.items():
            for rtol in (1e-2, 1e-6, 1e-10) if name not in ("dense", "identity") else (1e-10,):

                def solve(linear=solver.linear, rtol: float = rtol):
                    return problem.solve(linear, rtol, 10 * UNKNOWNS)

                found = solve()
                seconds, memory = timing.of(solve)
                detail = f"{found.products} products, {_words(found)}"
                setting = name if name in ("dense", "identity") else f"{name}, rtol {rtol:g}"
                error = relative(found.value, problem.x)
                points.append(Point(setting, error, seconds, memory, False, name, detail))
        note = (
            f"{UNKNOWNS} unknowns, float64, eigenvalues spread evenly in log from 1 to {1.0 / condition:.0e}; rtol "
            "allows an error of rtol times the condition number."
        )
        name = f"solver/condition {condition:.0e}"
        return Series(name, "relative error of the solution", tuple(points), (), note, timing.clock)

    def _products(self, make: Callable[..., Detector], timing: Timing, seed: int) -> Series:
        """Multiply by the Hessian on cached features in float32, and compare with the exact product in float64."""
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
            f"A Hessian product on {self.images} images of {self.size} px with cached features and {vector.numel()} "
            "parameters, in float32, compared with float64. A kept graph takes a gradient beforehand, and the memory "
            "of all images while it is kept; neither is counted."
        )
        return Series(
            "solver/one product", "relative error of the product", tuple(points), (), note, timing.clock
        )


def product_problem(
    make: Callable[..., Detector], images: int, size: int, seed: int
) -> tuple[list[Term], Parameters, list[Term]]:
    """Return the loss terms and parameters of an untrained detector on random pictures, and the terms in float64."""
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

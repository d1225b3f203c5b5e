"""The tables of ``benchmarks/solvers.py`` as Markdown, every number from its results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

SHORT = {
    "CONVERGED": "ok", "APPROXIMATE": "approx", "MAX_STEPS": "steps", "STAGNATED": "stagnated", "DIVERGED": "diverged",
    "NEGATIVE_CURVATURE": "negative", "SINGULAR": "singular", "LEAST_SQUARES": "least sq.", "NON_FINITE": "not finite",
}  # fmt: skip

ORACLE = """`detector=micro` (2 classes, 32 px), after its usual training, then trained to the minimum of the proximal
problem L_train + lambda/2 |theta - theta_0|^2 on one image of every bin (4) and object (2); psi
enters by the bins' weights. The lambda of factor 1 is the one that `solver/damping=lanczos` chooses in 12 products
at the warm start; the others show its effect. *Retrained*: central differences of the same problem,
retrained to a gradient below 1e-10; *cosine*: with those of 0.04 logits, in centred logits, the smaller
of the two objects'. *Exact*: relative error of the dense solve against retraining (differences of 0.04 and 0.02
logits extrapolated, so that their error is of fourth order), and against conjugate gradients run to
1e-12 on forward-over-reverse products."""
BUDGET = """Relative error of the hypergradient by conjugate gradients after so many Hessian products (the last one
checks the residual), and after a solve to rtol {rtol:g} of at most {max_steps} products:"""
SYSTEMS = """200 unknowns, float64, eigenvalues spread evenly in log from 1 to 1 / condition number; rtol 1e-10, at most
2000 steps. Relative error of the solution, status, milliseconds. This rtol allows an error of 1e-10 times the
condition number. `steps`: no steps left; `negative`: reported as not positive definite; `approx`: not iterated to a
tolerance. `nystrom`: rank 40, with half of the smallest eigenvalue as its shift."""
COSTS = """`detector=tiny`, 64 images of 96 px, cached features, float32: medians of 7, in gradients of the same
images, timed alternately. The default keeps the graph (`solver.retain_graph`), at the cost of one gradient
with its graph per outer step, and of the memory of all curvature images."""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def report(found: Mapping[str, Any]) -> str:
    """The whole section."""
    machine, rows = found["machine"], found["hypergradients"]
    parts = [
        "    python benchmarks/solvers.py",
        f"One thread, {machine['processor']}, torch {machine['torch']}; times are processor times.",
        "### The hypergradient against a dense solve and against retraining",
        ORACLE,
        _oracle_table(rows),
        BUDGET.format(**found["default"]),
        _budget_table(rows),
        _verdict(rows),
        "### Solver by condition number",
        SYSTEMS,
        _system_table(found["systems"], False),
        "The same with alternating signs:",
        _system_table(found["systems"], True),
        "### What a curvature product costs",
        COSTS,
        _cost_table(found["costs"]),
    ]
    return "\n\n".join(parts)


def _oracle_table(rows: Sequence[Mapping[str, Any]]) -> str:
    head = ["lambda", "factor", "gradient norm", "H + lambda", "condition", "cosine with retrained",
            "exact: to retrained", "exact: to iterated"]  # fmt: skip
    return table(
        head,
        [
            [
                f"{row['lambda']:.3g}", f"{row['of_default']:.2g}", f"{row['stationarity']:.0e}",
                f"{row['lambda_min']:.2g} to {row['lambda_max']:.3g}", f"{row['condition']:.3g}",
                f"{row['cosine']:.7f}" if row["converged"] else "not retrained", f"{row['exact_to_retrained']:.0e}",
                f"{row['exact_to_iterated']:.0e}",
            ]
            for row in rows
        ],
    )  # fmt: skip


def _budget_table(rows: Sequence[Mapping[str, Any]]) -> str:
    head = ["lambda", *map(str, rows[0]["error"]), "stopped", "products"]
    return table(
        head,
        [
            [f"{row['lambda']:.3g}", *(f"{error:.0e}" for error in row["error"].values()),
             f"{row['default_error']:.1e}", f"{row['default_products']}, {SHORT[row['default_status']]}"]
            for row in rows
        ],
    )  # fmt: skip


def _verdict(rows: Sequence[Mapping[str, Any]]) -> str:
    reached = [
        f"{row['lambda']:.3g} (condition {row['condition']:.3g})"
        for row in rows
        if row["default_error"] < 1e-2
    ]
    missed = [f"{row['lambda']:.3g} ({row['condition']:.3g})" for row in rows if row["default_error"] >= 1e-2]
    text = f"That solve has an error below 1e-2 at lambda {', '.join(reached) or '(none)'}"
    return text + (f", but not at {', '.join(missed)}, which its status reports." if missed else ".")


def _system_table(rows: Sequence[Mapping[str, Any]], indefinite: bool) -> str:
    kept = [row for row in rows if row["indefinite"] is indefinite]
    conditions = sorted({row["condition"] for row in kept})
    cells = {
        (
            row["solver"],
            row["condition"],
        ): f"{row['error']:.0e} {SHORT[row['status']]} {1e3 * row['seconds']:.0f}"
        for row in kept
    }
    names = list(dict.fromkeys(row["solver"] for row in kept))
    head = ["solver", *(f"{condition:.0e}" for condition in conditions)]
    return table(head, [[name, *(cells[name, condition] for condition in conditions)] for name in names])


def _cost_table(rows: Sequence[Mapping[str, Any]]) -> str:
    return table(
        ["product", "graph kept", "gradients", "ms"],
        [
            [
                row["operator"], "yes" if row["retain_graph"] else "no", f"{row['product'] / row['gradient']:.1f}",
                f"{1e3 * row['product']:.0f}",
            ]
            for row in rows
        ],
    )  # fmt: skip

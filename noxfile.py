"""Run the project in its own environments, for example ``nox -s demo``; ``nox -l`` lists the sessions."""

import nox

nox.options.default_venv_backend = "uv"
nox.options.reuse_existing_virtualenvs = True
nox.options.sessions = ["lint", "types", "tests"]


def _install(session: nox.Session, editable: bool = True, many_processes: bool = False) -> None:
    """Install the locked environment with all extras, then the project itself without resolving again.

    With ``many_processes`` the environment is compiled to bytecode up front; if PYTHONDONTWRITEBYTECODE is set, every
    process would otherwise spend some ten seconds on compiling it.
    """
    session.install("-r", "requirements.lock", env={"UV_COMPILE_BYTECODE": "1"} if many_processes else None)
    session.install("--no-deps", *(["-e"] if editable else []), ".")
    session.env["OMP_WAIT_POLICY"] = "PASSIVE"
    session.env["GOMP_SPINCOUNT"] = "20000"


@nox.session
def demo(session: nox.Session) -> None:
    """Learn which poses of the embedded objects to render; takes minutes on two cores."""
    _install(session)
    session.run("python", "-m", "src.main", "+experiment=pose_gap", "scale=quick", *session.posargs)


@nox.session
def tests(session: nox.Session) -> None:
    """Run the fast tests in up to four single-threaded processes."""
    _install(session, many_processes=True)
    session.env["OMP_NUM_THREADS"] = "1"
    session.run(
        "python", "-m", "pytest", "-n", "auto", "--maxprocesses", "4", "--dist", "worksteal", *session.posargs
    )


@nox.session
def slow(session: nox.Session) -> None:
    """Run the tests that take minutes, including every documented command, in one process per core."""
    _install(session, many_processes=True)
    session.env["OMP_NUM_THREADS"] = "1"
    session.run("python", "-m", "pytest", "-m", "slow", "-n", "auto", "--dist", "worksteal", *session.posargs)


@nox.session
def coverage(session: nox.Session) -> None:
    """Measure the branch coverage of the mathematics by its own tests; fail below 95 %."""
    _install(session)
    session.env["OMP_NUM_THREADS"] = "1"
    packages = ("parameter", "gradient", "solver")
    session.run(
        "python", "-m", "pytest", *(f"tests/{name}" for name in packages),
        *(f"--cov=neural_sim.{name}" for name in packages),
        "--cov-branch", "--cov-fail-under=95", "--cov-report=term-missing:skip-covered", *session.posargs,
    )  # fmt: skip


@nox.session
def lint(session: nox.Session) -> None:
    """Check style, format and spelling, without importing the project."""
    session.install("-c", "requirements.lock", "ruff", "codespell")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("codespell")


@nox.session
def lock(session: nox.Session) -> None:
    """Regenerate requirements.lock from pyproject.toml; ``nox -s lock -- --upgrade`` moves to newer releases."""
    session.install("uv")
    session.run(
        "uv", "pip", "compile", "pyproject.toml", "--all-extras", "--group", "dev", "--universal",
        "--no-annotate", "--no-header", "-o", "requirements.lock", *session.posargs,
    )  # fmt: skip


@nox.session
def types(session: nox.Session) -> None:
    """Check types with pyright."""
    _install(session)
    session.run("pyright")


@nox.session
def docs(session: nox.Session) -> None:
    """Build the documentation site in outputs/site; warnings are errors."""
    session.install("-r", "requirements.lock")
    session.run(
        "python", "-m", "mkdocs", "build", "--strict", *session.posargs, env={"NO_MKDOCS_2_WARNING": "1"}
    )


@nox.session
def bench(session: nox.Session) -> None:
    """Measure error against run time; ``nox -s bench -- outer export`` runs benchmarks/<name>.py instead."""
    _install(session)
    for name in session.posargs:
        session.run("python", f"benchmarks/{name}.py")
    if not session.posargs:
        session.run("python", "-m", "src.main", "+experiment=work_precision")

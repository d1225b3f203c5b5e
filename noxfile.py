"""Run the project in environments of its own: ``nox -s demo``, for example; ``nox -l`` lists the sessions."""

import nox

nox.options.default_venv_backend = "uv"
nox.options.reuse_existing_virtualenvs = True
nox.options.sessions = ["lint", "types", "tests"]


def _install(session: nox.Session, editable: bool = True, many_processes: bool = False) -> None:
    """Install the locked environment, extras included, then the project itself without resolving again.

    Where ``many_processes`` will import it, it is compiled once: each would otherwise take some ten seconds for that
    wherever PYTHONDONTWRITEBYTECODE is set.
    """
    session.install("-r", "requirements.lock", env={"UV_COMPILE_BYTECODE": "1"} if many_processes else None)
    session.install("--no-deps", *(["-e"] if editable else []), ".")
    session.env["OMP_WAIT_POLICY"] = "PASSIVE"
    session.env["GOMP_SPINCOUNT"] = "20000"


@nox.session
def demo(session: nox.Session) -> None:
    """Learn which poses to render for the embedded objects; takes minutes on two cores."""
    _install(session)
    session.run("python", "-m", "src.main", "+experiment=pose_gap", "scale=quick", *session.posargs)


@nox.session
def tests(session: nox.Session) -> None:
    """Run the fast tests, in up to four processes of one thread."""
    _install(session, many_processes=True)
    session.env["OMP_NUM_THREADS"] = "1"
    session.run(
        "python", "-m", "pytest", "-n", "auto", "--maxprocesses", "4", "--dist", "worksteal", *session.posargs
    )


@nox.session
def slow(session: nox.Session) -> None:
    """Run the tests that take minutes, every documented command among them, in one process per core."""
    _install(session, many_processes=True)
    session.env["OMP_NUM_THREADS"] = "1"
    session.run("python", "-m", "pytest", "-m", "slow", "-n", "auto", "--dist", "worksteal", *session.posargs)


@nox.session
def lint(session: nox.Session) -> None:
    """Check style, format and spelling; nothing of the project is imported."""
    session.install("-c", "requirements.lock", "ruff", "codespell")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("codespell")


@nox.session
def lock(session: nox.Session) -> None:
    """Resolve requirements.lock anew from pyproject.toml; ``nox -s lock -- --upgrade`` takes newer releases."""
    session.install("uv")
    session.run(
        "uv", "pip", "compile", "pyproject.toml", "--all-extras", "--group", "dev", "--universal",
        "--no-annotate", "--no-header", "-o", "requirements.lock", *session.posargs,
    )  # fmt: skip


@nox.session
def types(session: nox.Session) -> None:
    """Check static types."""
    _install(session)
    session.run("pyright")


@nox.session
def docs(session: nox.Session) -> None:
    """Build the documentation as a site in outputs/site; a warning is an error."""
    session.install("-r", "requirements.lock")
    session.run(
        "python", "-m", "mkdocs", "build", "--strict", *session.posargs, env={"NO_MKDOCS_2_WARNING": "1"}
    )


@nox.session
def bench(session: nox.Session) -> None:
    """Error against run time; ``nox -s bench -- outer export`` runs benchmarks/<name>.py instead."""
    _install(session)
    for name in session.posargs:
        session.run("python", f"benchmarks/{name}.py")
    if not session.posargs:
        session.run("python", "-m", "src.main", "+experiment=work_precision")

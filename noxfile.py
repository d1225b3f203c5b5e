"""Sessions that set up all they need, such as ``nox -s demo``; ``nox -l`` lists them."""

import nox

nox.options.default_venv_backend = "uv"
nox.options.reuse_existing_virtualenvs = True
nox.options.sessions = ["lint", "types", "tests"]


def _install(session: nox.Session, editable: bool = True) -> None:
    """The locked environment, extras included, then the project itself without resolving again."""
    session.install("-r", "requirements.lock")
    session.install("--no-deps", *(["-e"] if editable else []), ".")
    session.env["OMP_WAIT_POLICY"] = "PASSIVE"
    session.env["GOMP_SPINCOUNT"] = "20000"


@nox.session
def demo(session: nox.Session) -> None:
    """Learn which poses to render for the embedded objects; minutes on two cores."""
    _install(session)
    session.run("python", "-m", "src.main", "+experiment=pose_gap", "scale=quick", *session.posargs)


@nox.session
def tests(session: nox.Session) -> None:
    """The fast suite, one run through the command line included; up to four processes of one thread."""
    _install(session)
    session.env["OMP_NUM_THREADS"] = "1"
    session.run("python", "-m", "pytest", "-n", "auto", "--maxprocesses", "4", *session.posargs)


@nox.session
def slow(session: nox.Session) -> None:
    """The tests that take minutes, every documented command among them; one process a core."""
    _install(session)
    session.env["OMP_NUM_THREADS"] = "1"
    session.run("python", "-m", "pytest", "-m", "slow", "-n", "auto", "--dist", "worksteal", *session.posargs)


@nox.session
def lint(session: nox.Session) -> None:
    """Style and format; no part of the project is imported."""
    session.install("-r", "requirements.lock")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")


@nox.session
def types(session: nox.Session) -> None:
    """Static types."""
    _install(session)
    session.run("pyright")


@nox.session
def docs(session: nox.Session) -> None:
    """The documentation as a site, in outputs/site; a warning is an error."""
    session.install("-r", "requirements.lock")
    session.run(
        "python", "-m", "mkdocs", "build", "--strict", *session.posargs, env={"NO_MKDOCS_2_WARNING": "1"}
    )


@nox.session
def bench(session: nox.Session) -> None:
    """Error against run time, and the other benchmarks: tables on the screen, JSON under outputs."""
    _install(session)
    if not session.posargs:
        session.run("python", "-m", "src.main", "+experiment=work_precision")
    for name in session.posargs or ["field", "render", "outer"]:
        session.run("python", f"benchmarks/{name}.py")

"""The SQLite file of a tracking store: what it must be, and who may write to it."""

from __future__ import annotations

import sqlite3
from contextlib import AbstractContextManager, closing, nullcontext
from pathlib import Path
from typing import Any

_SQLITE = b"SQLite format 3\0"
"""How a database's file begins."""
_PATIENCE = 60.0
"""Seconds to wait for another program that is writing."""


def database_of(uri: str) -> Path | None:
    """Return the file of a SQLite store, None for others."""
    return Path(uri.removeprefix("sqlite:///")) if uri.startswith("sqlite:///") else None


def guard(uri: str) -> AbstractContextManager[Any]:
    """Let one writer at a time use a SQLite file, among this program's processes."""
    from filelock import FileLock

    database = database_of(uri)
    return nullcontext() if database is None else FileLock(f"{database}.lock")


def check_database(database: Path) -> None:
    """Refuse at once what MLflow would try to open for minutes: a folder, another kind of file, a damaged one.

    Raises:
        ValueError: with the file and what to do.
    """
    todo = "move it away, or set paths.mlflow"
    try:
        database.parent.mkdir(parents=True, exist_ok=True)
        if database.is_dir():
            raise ValueError(f"paths.mlflow: {database} is a folder, want a file; {todo}")
        if not database.exists() or not database.stat().st_size:
            return
        with database.open("rb") as file:
            if file.read(len(_SQLITE)) != _SQLITE:
                raise ValueError(f"paths.mlflow: {database} is no SQLite database; {todo}")
        with closing(
            sqlite3.connect(database.as_uri() + "?mode=ro", uri=True, timeout=_PATIENCE)
        ) as connection:
            connection.execute("select count(*) from sqlite_master").fetchone()
    except OSError as error:
        raise ValueError(
            f"paths.mlflow: {database} cannot be used ({error.strerror or error}); {todo}"
        ) from error
    except sqlite3.DatabaseError as error:
        raise ValueError(f"paths.mlflow: {database} is damaged ({error}); {todo}") from error

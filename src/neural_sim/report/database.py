"""The SQLite file of a tracking store: checks, a lock for writers, and upgrades of its schema."""

from __future__ import annotations

import logging
import sqlite3
from contextlib import AbstractContextManager, closing, nullcontext
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)

_SQLITE = b"SQLite format 3\0"
"""How a database's file begins."""
_PATIENCE = 60.0
"""Seconds to wait for another program that is writing."""


def database_of(uri: str) -> Path | None:
    """Return the absolute path of a SQLite store's file, None for other stores."""
    return Path(uri.removeprefix("sqlite:///")).absolute() if uri.startswith("sqlite:///") else None


def guard(uri: str) -> AbstractContextManager[Any]:
    """Lock a SQLite file, so that only one of this program's processes writes to it at a time."""
    from filelock import FileLock

    database = database_of(uri)
    return nullcontext() if database is None else FileLock(f"{database}.lock")


def check_database(database: Path) -> None:
    """Refuse what MLflow would try to open for minutes: a folder, a file that is no database, a damaged database.

    Raises:
        ValueError: the file cannot be used; the message says what to do.
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
                raise ValueError(f"paths.mlflow: {database} is not an SQLite database; {todo}")
        with closing(
            # Not read-only, so that SQLite can use its journal to roll back what a killed process left half written.
            sqlite3.connect(database.as_uri() + "?mode=rw", uri=True, timeout=_PATIENCE)
        ) as connection:
            connection.execute("select count(*) from sqlite_master").fetchone()
    except OSError as error:
        raise ValueError(
            f"paths.mlflow: {database} cannot be used ({error.strerror or error}); {todo}"
        ) from error
    except sqlite3.OperationalError as error:  # for instance, another program holds a lock, or the disk fails
        raise ValueError(f"paths.mlflow: {database} cannot be used ({error}); {todo}") from error
    except sqlite3.DatabaseError as error:
        raise ValueError(f"paths.mlflow: {database} is damaged ({error}); {todo}") from error


def upgrade(database: Path) -> None:
    """Upgrade a database of an older MLflow to the installed version's schema.

    The database is copied first, and a warning is logged. MLflow itself either upgrades without a copy or refuses the
    database. A schema that the installed version does not know stays as it is.
    """
    before = _schema_of(database)
    if before is None:
        return
    from alembic.script import ScriptDirectory
    from mlflow.store.db import utils
    from sqlalchemy import create_engine

    uri = f"sqlite:///{database}"
    scripts = ScriptDirectory.from_config(utils._get_alembic_config(uri))
    if before == scripts.get_current_head() or all(
        each.revision != before for each in scripts.walk_revisions()
    ):
        return
    copy = database.with_name(f"{database.name}.{before}.copy")
    _log.warning("mlflow: %s is of an older version: it is copied to %s and upgraded", database, copy.name)
    _copy(database, copy)
    engine = create_engine(uri)
    try:
        utils._upgrade_db(engine)
    finally:
        engine.dispose()


def _schema_of(database: Path) -> str | None:
    """Return the schema version of a database; None if it has no tables yet."""
    if not database.exists() or not database.stat().st_size:
        return None
    with closing(sqlite3.connect(database, timeout=_PATIENCE)) as connection:
        named = "select count(*) from sqlite_master where name = 'alembic_version'"
        if not connection.execute(named).fetchone()[0]:
            return None
        row = connection.execute("select version_num from alembic_version").fetchone()
    return None if row is None else row[0]


def _copy(database: Path, copy: Path) -> None:
    """Copy a database consistently, even while others write to it."""
    draft = copy.with_name(f".{copy.name}.part")
    draft.unlink(missing_ok=True)
    with (
        closing(sqlite3.connect(database, timeout=_PATIENCE)) as source,
        closing(sqlite3.connect(draft)) as target,
    ):
        source.backup(target)
    draft.replace(copy)

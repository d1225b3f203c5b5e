"""Run time of the same work in one process, in several, and on a Ray cluster: `python benchmarks/scaling.py fields`.

Whole commands are timed, including start-up and imports, each on a new store. Engines take turns, and the fastest round
of each counts, because other programs on the machine can only slow a command down.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from neural_sim.documents import markdown_table, write_json
from neural_sim.report.provenance import machine
from neural_sim.report.tracking import connect, tracking_uri

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Case:
    """Work that several processes can share.

    Attributes:
        words: the command.
        engines: overrides added to it, by engine.
        before: command whose results are in the store beforehand.
    """

    words: str
    engines: dict[str, str]
    before: str = ""


RUN = {"1 process": "workers=1", "2 processes": "workers=2", "ray": "workers=ray"}
DATA_SET = "+experiment=pose_gap scale=smoke stages=[export] export.psi=target export.detail=run"
CASES = {
    "fields": Case("+experiment=pose_gap scale=quick stages=[field]", RUN),
    "export": Case(
        f"{DATA_SET} export.count=200 export.width=320 export.height=240",
        {"1 process": "export.workers=0", "2 processes": "export.workers=2", "ray": "workers=ray"},
        f"{DATA_SET} export.count=1",
    ),
    "sweep": Case(
        "-m +experiment=pose_gap scale=smoke seed=0,1,2,3",
        {
            "one after another": "hydra/launcher=basic", "local": "hydra/launcher=local",
            "slurm_local": "hydra/launcher=slurm_local",
        },
    ),
}  # fmt: skip


def timed(words: list[str], folder: Path, database: Path) -> float:
    """Run a command on the store in ``folder``; return its seconds."""
    shutil.copy(database, folder / "mlflow.db")
    mode = "sweep" if "-m" in words else "run"
    paths = [
        f"paths.store={folder}/store",
        f"paths.mlflow={folder}/mlflow.db",
        f"hydra.{mode}.dir={folder}/run",
    ]
    command = [sys.executable, "-m", "src.main", *words, "progress=false", *paths]
    begun = time.monotonic()
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True
    )
    if done.returncode != 0:
        raise SystemExit(f"{shlex.join(command)}:\n{done.stderr[-3000:]}")
    return time.monotonic() - begun


def main() -> None:
    """Time a case and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", choices=CASES)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--out", type=Path, help="a JSON file")
    given = parser.parse_args()
    case = CASES[given.case]
    seconds: dict[str, list[float]] = {engine: [] for engine in case.engines}
    with tempfile.TemporaryDirectory(prefix="scaling") as folder:
        database, prepared = Path(folder) / "empty.db", Path(folder) / "prepared"
        connect(tracking_uri(str(database)))
        prepared.mkdir()
        if case.before:
            timed(shlex.split(case.before), prepared, database)
            shutil.rmtree(prepared / "run")
        for number in range(given.rounds):
            for engine, words in case.engines.items():
                place = Path(folder) / f"{len(seconds[engine])} {engine}".replace(" ", "_")
                shutil.copytree(prepared, place)
                seconds[engine].append(timed([*shlex.split(case.words), words], place, database))
                shutil.rmtree(place)
            print(
                f"round {number + 1}:",
                {engine: round(spent[-1], 1) for engine, spent in seconds.items()},
                flush=True,
            )
    alone = min(next(iter(seconds.values())))
    rows = [[engine, f"{min(spent):.0f} s", f"{alone / min(spent):.2f}"] for engine, spent in seconds.items()]
    print(markdown_table([given.case, "time", "times as fast"], rows))
    if given.out is not None:
        write_json(given.out, {"case": vars(case), "seconds": seconds, "machine": machine()})


if __name__ == "__main__":
    main()

"""Kill a run at random moments, damage its files, and count what is lost.

    python benchmarks/faults.py --out faults.json

The reference is one small run, from objects to a report and a data set. The same command is then killed and restarted
on one store until it finishes; every such chain must reproduce the results of the reference bit for bit. Next, bits of
stored files are flipped and files truncated; no damaged file may be used. Last, several runs of the command are started
at the same time.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import json
import logging
import multiprocessing
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import torch

from neural_sim.documents import write_json
from neural_sim.stages.psi import _STATE
from neural_sim.stages.store import CHECKPOINT, Store

SMALL = [
    "+experiment=pose_gap", "scale=smoke", "progress=false", "detector=micro", "objects.names=[pitcher,drill]",
    "views.count=8", "views.held_out=2", "budget.grid.steps=150", "budget.grid.resolution=64",
    "budget.outer.iterations=6", "outer.epochs=4", "target.val_per_object=4",
    "stages=[views,field,target_sets,warm_start,psi,evaluate,report,export]",
    "export.count=12", "export.workers=0", "export.detail=run",
]  # fmt: skip
LOADED = ["neural_sim.main", "neural_sim.tasks.walk", "mlflow", "faster_coco_eval", "matplotlib.pyplot"]
"""Modules that processes import in advance, so that they are killed at work and not while importing."""
ITERATION = re.compile(r"psi (\d+)/\d+:")
ENDS = {"report": "results.json", "export": "dataset"}
"""Phases of a run without a result in the store; each has started once this file or folder exists."""
TAKEN_UP = re.compile(r"psi loop: goes on after round (\d+)/")
FIELD_EVERY = 0.5
"""Seconds between checkpoints of a field; short, because fits here take seconds."""


def run_command(arguments: list[str], log: str) -> None:
    """Run the program in this process, with its output in a file."""
    from neural_sim import main
    from neural_sim.stages import field as fields

    fields.EVERY = FIELD_EVERY
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    sys.argv = ["neural-sim", *arguments]
    main.main()


@dataclass
class Place:
    """A store, a database and the folders of the runs that use them."""

    root: Path
    runs: int = 0

    @property
    def store(self) -> Store:
        """The store."""
        return Store(self.root / "store")

    @property
    def run(self) -> Path:
        """The folder of the last run."""
        return self.root / f"run{self.runs}"

    @property
    def log(self) -> str:
        """The output of the last run."""
        path = Path(f"{self.run}.log")
        return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""

    def start(self, log: Path | None = None) -> Any:
        """Start the command in a new process and a new folder; what it says goes to ``log``, or next to the folder."""
        self.runs += 1
        paths = [f"paths.store={self.root}/store", f"paths.mlflow={self.root}/mlflow.db"]
        arguments = [*SMALL, *paths, f"hydra.run.dir={self.run}"]
        process = _processes().Process(target=run_command, args=(arguments, str(log or f"{self.run}.log")))
        process.start()
        return process

    def stored(self) -> dict[str, str]:
        """Return digests of all results in the store, excluding times."""
        found = {}
        for path in sorted(self.store.root.glob("*/[!.]*.pt")):
            entry = self.store.fetch(path.parent.name, path.stem, {}, functools.partial(_missing, path))
            found[f"{path.parent.name}/{path.stem}"] = _digest(entry.value)
        return found

    def bits(self) -> dict[str, str]:
        """Return digests of all results, excluding times, and of the data set."""
        found = self.stored()
        for path in sorted((self.run / "dataset").rglob("*")):
            if path.is_file():
                found[str(path.relative_to(self.run))] = hashlib.sha256(path.read_bytes()).hexdigest()
        return found

    def at_work_on(self, kind: str) -> bool:
        """Tell whether a process is making a result of this kind, or has started that phase of the run."""
        if kind in ENDS:
            return (self.run / ENDS[kind]).exists()
        held = Path("/proc/locks").read_text()
        locks = self.store.root.glob(f"{kind}/*.lock")
        return any(re.search(rf":{path.stat().st_ino} ", held) for path in locks)

    def has_done(self, kind: str, count: int) -> bool:
        """Tell whether all results of a kind exist."""
        return kind not in ENDS and len(list(self.store.root.glob(f"{kind}/[!.]*.pt"))) >= count


def _processes() -> Any:
    """Return a multiprocessing context whose processes have the program imported already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(LOADED)
    return context


def _missing(path: Path) -> Any:
    raise RuntimeError(f"{path} is not what was written")


def _digest(value: Any) -> str:
    total = hashlib.sha256()

    def add(tree: Any) -> None:
        if isinstance(tree, torch.Tensor):
            total.update(f"{tree.dtype}{tuple(tree.shape)}".encode() + tree.contiguous().numpy().tobytes())
        elif isinstance(tree, Mapping):
            for key, item in tree.items():
                if "seconds" not in str(key):
                    total.update(str(key).encode())
                    add(item)
        elif isinstance(tree, (list, tuple)):
            for item in tree:
                add(item)
        else:
            total.update(repr(tree).encode())

    add(value)
    return total.hexdigest()


@dataclass
class Ends:
    """Counts of processes ended by SIGKILL or SIGTERM, and of the consequences."""

    at: Counter[str] = field(default_factory=Counter)
    statuses: Counter[int] = field(default_factory=Counter)
    chains: int = 0
    same: int = 0
    different: list[str] = field(default_factory=list)
    taken_up: int = 0
    iterations_lost: int = 0
    slowest_end: float = 0.0
    left_running: int = 0


def chains(
    signum: signal.Signals, count: int, reference: Place, bits: Mapping[str, str], random: Random
) -> tuple[Ends, Path | None]:
    """End ``count`` processes, each at a random moment of a kind of work still to be done, and let every chain finish.

    Returns:
        The counts, and a checkpoint found on the way.
    """
    ends, ended, checkpoint, work = Ends(), 0, None, reference.root.parent
    parts = _parts(reference)
    while ended < count:
        place, done = Place(work / f"{signum.name}{ends.chains}"), 0
        place.root.mkdir()
        shutil.copy(work / "empty.db", place.root / "mlflow.db")
        while True:
            process = place.start()
            if ended < count:
                left = [kind for kind, (number, _) in parts.items() if not place.has_done(kind, number)]
                kind = random.choice(left)
                _wait(process, place, kind, random.uniform(0.0, parts[kind][1]))
            else:
                process.join()
            if process.is_alive():
                ended += 1
                begun = time.monotonic()
                os.kill(process.pid, signum)
                process.join()
                ends.slowest_end = max(ends.slowest_end, time.monotonic() - begun)
                ends.at[kind] += 1
                ends.statuses[process.exitcode] += 1
                found = sorted(place.store.root.glob(f"psi/*{CHECKPOINT}"))
                if found and checkpoint is None:
                    checkpoint = Path(shutil.copy(found[0], work / found[0].name))
            done = _iterations(place.log, done, ends)
            if process.exitcode == 0:
                break
            if process.exitcode not in (-signum, 128 + signum):
                raise SystemExit(f"a run failed with status {process.exitcode}:\n{place.log[-3000:]}")
        found = place.bits()
        ends.chains += 1
        wrong = _different(bits, found)
        ends.same += not wrong
        ends.different += wrong
        ends.left_running += _running(place.root / "mlflow.db")
        shutil.rmtree(place.root)
    return ends, checkpoint


def _parts(reference: Place) -> dict[str, tuple[int, float]]:
    """Return the number of results of each kind, and the time of the longest in seconds."""
    found: dict[str, tuple[int, float]] = {}
    for path in reference.store.root.glob("*/[!.]*.pt"):
        entry = reference.store.fetch(path.parent.name, path.stem, {}, functools.partial(_missing, path))
        count, longest = found.get(path.parent.name, (0, 0.0))
        found[path.parent.name] = (count + 1, max(longest, entry.seconds))
    return {**found, **{kind: (1, _seconds(reference, kind)) for kind in ENDS}}


def _seconds(reference: Place, phase: str) -> float:
    said = re.search(rf"^{phase} +([\d.]+) s$", reference.log, re.MULTILINE)
    return 1.0 if said is None else float(said[1])


def _wait(process: Any, place: Place, kind: str, seconds: float) -> None:
    """Wait until a process works on this kind of result, and some seconds longer, or until it ends."""
    while process.is_alive() and not place.at_work_on(kind):
        time.sleep(0.01)
    process.join(seconds)


def _iterations(log: str, done: int, ends: Ends) -> int:
    """Return the number of finished iterations in a chain, and count those that a run repeated."""
    if (taken := TAKEN_UP.search(log)) is not None:
        ends.taken_up += 1
        ends.iterations_lost = max(ends.iterations_lost, done - int(taken[1]))
    elif done and ITERATION.search(log):
        ends.iterations_lost = max(ends.iterations_lost, done)
    return max([done, *(int(match[1]) for match in ITERATION.finditer(log))])


def _running(database: Path) -> int:
    from mlflow import MlflowClient

    client = MlflowClient(f"sqlite:///{database}")
    ids = [experiment.experiment_id for experiment in client.search_experiments()]
    return len(client.search_runs(ids, "attributes.status = 'RUNNING'"))


def damages(place: Place, checkpoint: Path | None, count: int, random: Random) -> dict[str, Any]:
    """Flip bits in results and a checkpoint, or truncate them; count damaged files that are read nevertheless."""
    kinds: Mapping[str, Callable[[bytes], bytes]] = {
        "flipped bit": functools.partial(_flipped, random=random),
        "truncation": lambda content: content[: random.randrange(len(content))],
    }
    paths, used, times = sorted(place.store.root.glob("*/[!.]*.pt")), 0, Counter[str]()
    if checkpoint is not None:
        paths.append(Path(shutil.copy(checkpoint, place.store.root / "psi")))
    for number in range(count):
        path, kind = random.choice(paths), list(kinds)[number % len(kinds)]
        whole = path.read_bytes()
        path.write_bytes(kinds[kind](whole))
        if path.suffix == CHECKPOINT:
            used += place.store.state(path.parent.name, path.stem, _STATE) is not None
        else:
            used += place.store.fetch(path.parent.name, path.stem, {}, lambda: "again").value != "again"
        path.write_bytes(whole)
        times[f"{kind} of a {'checkpoint' if path.suffix == CHECKPOINT else 'result'}"] += 1
    return {"count": count, "used": used, **times}


def _flipped(content: bytes, random: Random) -> bytes:
    at, bit = random.randrange(len(content)), random.randrange(8)
    return content[:at] + bytes([content[at] ^ 1 << bit]) + content[at + 1 :]


def _different(bits: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    """Return the names of results that have other bits, or that only one of the two has."""
    return sorted(key for key in {*bits, *found} if bits.get(key) != found.get(key))


def together(work: Path, bits: Mapping[str, str], count: int) -> dict[str, Any]:
    """Start the command several times at once, on one store and one database."""
    place = Place(work / "together")
    place.root.mkdir()
    shutil.copy(work / "empty.db", place.root / "mlflow.db")
    begun = time.monotonic()
    processes = [place.start() for _ in range(count)]
    for process in processes:
        process.join()
    seconds = time.monotonic() - begun
    runs = [Place(place.root, number) for number in range(1, count + 1)]
    return {
        "count": count, "failed": sum(process.exitcode != 0 for process in processes),
        "different": sorted({key for run in runs for key in _different(bits, run.bits())}),
        "seconds": round(seconds, 1),
        "waits": sum(run.log.count("store: waiting") for run in runs),
        "left_running": _running(place.root / "mlflow.db"),
    }  # fmt: skip


def reference_in(work: Path) -> tuple[Place, float]:
    """Run the command undisturbed; return where, and its seconds. ``empty.db`` in ``work`` is a new database."""
    from neural_sim.report.tracking import connect, tracking_uri

    connect(tracking_uri(str(work / "empty.db")))
    place = Place(work / "reference")
    place.root.mkdir()
    shutil.copy(work / "empty.db", place.root / "mlflow.db")
    first = _processes().Process(target=time.sleep, args=(0,))
    first.start()
    first.join()
    begun = time.monotonic()
    process = place.start()
    process.join()
    if process.exitcode != 0:
        raise SystemExit(f"the reference failed:\n{place.log[-3000:]}")
    return place, time.monotonic() - begun


def main() -> None:
    """Run all parts and write the document."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50, help="by SIGKILL")
    parser.add_argument("--terms", type=int, default=20, help="by SIGTERM")
    parser.add_argument("--damages", type=int, default=1000, help="of files")
    parser.add_argument("--together", type=int, default=8, help="runs at one time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="a JSON file")
    given, random = parser.parse_args(), Random(0)
    random.seed(given.seed)
    with tempfile.TemporaryDirectory(prefix="faults") as folder:
        work = Path(folder)
        place, seconds = reference_in(work)
        reference = place.bits()
        document: dict[str, Any] = {"results": len(reference), "seconds": round(seconds, 1)}
        checkpoint = None
        for name, signum, count in (
            ("kills", signal.SIGKILL, given.kills), ("terms", signal.SIGTERM, given.terms),
        ):  # fmt: skip
            ends, met = chains(signum, count, place, reference, random)
            checkpoint = checkpoint or met
            document[name] = {"count": count, **vars(ends)}
        logging.getLogger("neural_sim.stages.store").setLevel(logging.ERROR)
        document["damages"] = damages(place, checkpoint, given.damages, random)
        document["together"] = together(work, reference, given.together)
    print(json.dumps(document, indent=1))
    if given.out is not None:
        write_json(given.out, document)


if __name__ == "__main__":
    main()

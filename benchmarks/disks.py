"""Runs on a disk that fills, or is read-only after some time: `python benchmarks/disks.py --out disks.json`.

The store, the database, and the folders of the runs lie on a RAM disk of a given size. What a run says when it cannot
write, and whether its status tells, is noted; then the disk gets room, and the same command must end with the bits of a
run that never met a full disk. Only root may mount a disk, for example in a container.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Any

from faults import Place, reference_in

from neural_sim.documents import write_json

ROOMY = "1g"


@contextmanager
def disk(folder: Path, size: str) -> Iterator[None]:
    """Mount a RAM disk of some size."""
    folder.mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


def remount(folder: Path, options: str) -> None:
    """Mount a disk again, with other options."""
    subprocess.run(["mount", "-o", f"remount,{options}", folder], check=True)


def trial(
    folder: Path, empty: Path, bits: dict[str, str], size: str, seconds: float | None
) -> dict[str, Any]:
    """Run the command where it cannot write, then again where it can.

    Args:
        folder: where the disk is mounted.
        empty: a new database.
        bits: those of a run that always had room.
        size: the disk's size.
        seconds: when a first run is killed, whose disk then becomes read-only; None for a disk that fills.
    """
    log = folder.parent / "said.log"
    log.unlink(missing_ok=True)
    with disk(folder, size):
        place = Place(folder)
        shutil.copy(empty, folder / "mlflow.db")
        if seconds is not None:
            killed = place.start(folder.parent / "killed.log")
            killed.join(seconds)
            killed.kill()
            killed.join()
            remount(folder, "ro")
        process = place.start(log)
        process.join()
        said = log.read_text(errors="replace")
        remount(folder, f"rw,size={ROOMY}")
        right = all(bits.get(name) == bit for name, bit in place.stored().items())
        again = place.start(folder.parent / "again.log")
        again.join()
        same = again.exitcode == 0 and place.bits() == bits
    return {
        "size": size, "read_only_after": seconds, "status": process.exitcode, "traceback": "Traceback" in said,
        "said": [line for line in said.splitlines() if line.startswith("neural-sim:")][-1:],
        "intact": right, "same": same,
    }  # fmt: skip


def main() -> None:
    """Run all trials, and write the document."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", type=int, default=10, help="disks too small for the run")
    parser.add_argument("--read-only", type=int, default=5, help="disks that are read-only after some time")
    parser.add_argument("--out", type=Path, help="a JSON file")
    given, random = parser.parse_args(), Random(0)
    if os.geteuid() != 0:
        raise SystemExit("only root may mount disks; run this in a container")
    logging.getLogger("neural_sim.stages.store").setLevel(logging.ERROR)
    trials = []
    with tempfile.TemporaryDirectory(prefix="disks") as folder:
        work = Path(folder)
        place, seconds = reference_in(work)
        bits, empty = place.bits(), work / "empty.db"
        least = empty.stat().st_size // 1024
        whole = sum(path.stat().st_size for path in place.root.rglob("*") if path.is_file()) // 1024
        sizes = [least + (whole - least) * (n + 1) // (given.full + 1) for n in range(given.full)]
        cases = [(f"{size}k", None) for size in sizes]
        cases += [(ROOMY, round(random.uniform(0.05, 0.95) * seconds, 1)) for _ in range(given.read_only)]
        for size, moment in cases:
            trials.append(trial(work / "disk", empty, bits, size, moment))
            print(trials[-1], flush=True)
    document = {
        "trials": len(trials), "tracebacks": sum(one["traceback"] for one in trials),
        "refused": sum(one["status"] == 2 and len(one["said"]) == 1 for one in trials),
        "intact": sum(one["intact"] for one in trials), "same": sum(one["same"] for one in trials), "each": trials,
    }  # fmt: skip
    print(json.dumps({key: value for key, value in document.items() if key != "each"}))
    if given.out is not None:
        write_json(given.out, document)


if __name__ == "__main__":
    main()

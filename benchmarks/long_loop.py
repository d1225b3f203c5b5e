"""Cost of checkpoints and growth of memory in a psi loop of many iterations.

    python benchmarks/long_loop.py --out long_loop.json

Resident memory is not the memory in use: ``used`` is what malloc has handed out, ``objects`` counts blocks of Python. A
leak makes these grow; if only the resident set grows, malloc is keeping fragments.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from faults import SMALL

from neural_sim.documents import write_json
from neural_sim.stages.store import Store

WARM = 50
"""Iterations after which memory is compared."""
SHOWN = 20


class Malloc(ctypes.Structure):
    """``struct mallinfo2`` of glibc, in bytes."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost",
        )
    ]  # fmt: skip


def watched(keep: Callable[..., None], rows: list[dict[str, float]]) -> Callable[..., None]:
    """Wrap the writing of checkpoints to record its time and the memory of the process at that moment."""
    libc = ctypes.CDLL("libc.so.6")
    libc.mallinfo2.restype = Malloc

    def writing(store: Store, kind: str, key: str, state: Any) -> None:
        begun = time.process_time()
        keep(store, kind, key, state)
        now, malloc = time.process_time(), libc.mallinfo2()
        if kind == "psi":
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            rows.append(
                {
                    "at": now, "spent": now - begun, "resident": pages * os.sysconf("SC_PAGE_SIZE"),
                    "used": malloc.uordblks + malloc.hblkhd, "objects": sys.getallocatedblocks(),
                }
            )  # fmt: skip

    return writing


def main() -> None:
    """Run the loop and write the document."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=200)
    parser.add_argument("--out", type=Path, help="a JSON file")
    given = parser.parse_args()
    rows: list[dict[str, float]] = []
    Store.keep = watched(Store.keep, rows)
    with tempfile.TemporaryDirectory(prefix="long_loop") as folder:
        from neural_sim import main as program

        small = [word for word in SMALL if not word.startswith(("budget.outer.iterations=", "stages="))]
        sys.argv = [
            "neural-sim", *small, "baseline=neural_sim_derivative", "stages=[psi]",
            f"budget.outer.iterations={given.iterations}", f"paths.store={folder}/store", f"hydra.run.dir={folder}/run",
        ]  # fmt: skip
        program.main()
    first, last = rows[min(WARM, len(rows) - 1)], rows[-1]
    spent = last["at"] - rows[0]["at"]
    shown = rows[:: max(len(rows) // SHOWN, 1)]
    document = {
        "iterations": len(rows),
        "cpu_seconds_an_iteration": round(spent / max(len(rows) - 1, 1), 3),
        "checkpoint_ms": round(1000 * sum(row["spent"] for row in rows[1:]) / max(len(rows) - 1, 1), 2),
        "checkpoints_part": round(sum(row["spent"] for row in rows[1:]) / spent, 5),
        "growth": {key: round(last[key] / first[key] - 1, 4) for key in ("resident", "used", "objects")},
        "resident_mb": [round(row["resident"] / 2**20, 1) for row in shown],
        "used_mb": [round(row["used"] / 2**20, 1) for row in shown],
    }
    print(json.dumps(document, indent=1))
    if given.out is not None:
        write_json(given.out, document)


if __name__ == "__main__":
    main()

"""Task ``doctor``: check whether this machine, the store and the database are fit for the configuration."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from packaging.requirements import Requirement
from typing_extensions import override

import neural_sim
from neural_sim.configuration import first_line
from neural_sim.devices import device_of
from neural_sim.documents import markdown_table, write_json
from neural_sim.extras import PACKAGES, missing_of
from neural_sim.ranges import PositiveInt, validated
from neural_sim.renderer.views import opengl_platform
from neural_sim.report.provenance import gpu
from neural_sim.report.tracking import close_abandoned, connect, quiet
from neural_sim.stages.store import Store
from neural_sim.tasks.context import Context, Task, TaskFailure

Health = Literal["ok", "note", "bad"]


@dataclass(frozen=True)
class Finding:
    """Result of one check. ``note``: it costs time or a feature; ``bad``: it stops runs or spoils their results.

    Attributes:
        health: ok, note or bad.
        what: subject of the check.
        found: its state.
        advice: what to do about it; empty: nothing.
    """

    health: Health
    what: str
    found: str
    advice: str = ""


@validated
@dataclass(frozen=True)
class DoctorTask(Task):
    """Checks of packages, device, memory, OpenGL, store, database and data; the exit status is 1 if one is bad.

    Args:
        memory_gb: free memory below which there is a note; a run at ``scale=quick`` takes 2 to 3 GB.
        disk_gb: free space on the disk of the store below which there is a note.
    """

    memory_gb: PositiveInt = 4
    disk_gb: PositiveInt = 5

    @override
    def run(self, context: Context) -> None:
        found = list(self.findings(context))
        write_json(context.folder / "doctor.json", [vars(each) for each in found])
        print(
            markdown_table(
                ["", "what", "found", "what to do"], [tuple(vars(each).values()) for each in found]
            )
        )
        bad = [each.what for each in found if each.health == "bad"]
        if bad:
            raise TaskFailure(f"doctor: {', '.join(bad)}")

    def findings(self, context: Context) -> Iterator[Finding]:
        """Yield the findings of all checks, in order; a check that raises is a bad finding."""
        paths, accelerator = context.config["paths"], context.config["trainer"]["accelerator"]
        store = Path(paths["store"]).expanduser()
        checks: list[tuple[str, Callable[[], Iterator[Finding]]]] = [
            ("packages", packages),
            ("device", lambda: devices(accelerator)),
            ("memory", self._memory),
            ("OpenGL", opengl),
            ("store", lambda: self._store(store)),
            ("MLflow", lambda: database(context.uri)),
            ("data", lambda: data(Path(paths["data"]).expanduser())),
        ]
        for what, check in checks:
            try:
                yield from check()
            except Exception as error:  # whatever a broken machine raises is a finding
                yield Finding("bad", what, first_line(error))

    def _memory(self) -> Iterator[Finding]:
        free = _free_memory_gb()
        if free is None:
            yield Finding("note", "memory", "this system does not say how much is free")
        else:
            low = free < self.memory_gb
            advice = "close other programs, or use scale=smoke" if low else ""
            yield Finding("note" if low else "ok", "memory", f"{free:.1f} GB free", advice)

    def _store(self, root: Path) -> Iterator[Finding]:
        folder = next(path for path in (root, *root.absolute().parents) if path.exists())
        if not folder.is_dir():
            yield Finding("bad", "store", f"{folder} is a file", "set paths.store to a folder")
            return
        if not os.access(folder, os.W_OK | os.X_OK):
            yield Finding(
                "bad", "store", f"{folder} cannot be written to", "change its permissions, or set paths.store"
            )
            return
        free = shutil.disk_usage(folder).free / 2**30
        low = free < self.disk_gb
        yield Finding(
            "note" if low else "ok", "disk of the store", f"{free:.1f} GB free", "make room" if low else ""
        )
        audit = Store(root).audit()
        yield Finding("ok", "store", f"{root}: {len(audit.sound)} results, {audit.bytes / 2**20:.0f} MB")
        if audit.damaged:
            names = ", ".join(str(path) for path in audit.damaged[:3])
            yield Finding(
                "bad", "results in the store", f"{len(audit.damaged)} are damaged or of an older version: {names}",
                "the next run that needs one makes it again; if they are recent, check the disk",
            )  # fmt: skip
        if audit.checkpoints:
            size = sum(path.stat().st_size for path in audit.checkpoints) / 2**20
            yield Finding(
                "note", "checkpoints in the store", f"{len(audit.checkpoints)} of unfinished work, {size:.0f} MB",
                "the same command resumes from them; delete the *.checkpoint files of work that you no longer want",
            )  # fmt: skip
        if audit.left:
            yield Finding(
                "note", "results in the store", f"{len(audit.left)} files left by killed runs or set aside as damaged",
                "later runs remove half-written files; delete *.damaged",
            )  # fmt: skip


def packages() -> Iterator[Finding]:
    """Compare the installed packages with the requirements of this one."""
    versions, wrong = [], []
    for text in importlib.metadata.requires("neural-sim") or []:
        requirement = Requirement(text)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            wrong.append(f"{requirement.name} is not installed")
            continue
        if not requirement.specifier.contains(version, prereleases=True):
            wrong.append(f"{requirement.name} {version}, want {requirement.specifier}")
        versions.append(f"{requirement.name} {version}")
    ours = f"neural-sim {neural_sim.__version__}, Python {platform.python_version()}"
    advice = "pip install -r requirements.lock" if wrong else ""
    yield Finding(
        "bad" if wrong else "ok",
        "packages",
        "; ".join(wrong) or f"{ours}, {len(versions)} required packages",
        advice,
    )
    if _is_installed("pyrender"):
        yield Finding(
            "bad", "pyrender", "pyrender itself is installed over scikit-robot-pyrender, whose files it overwrites",
            "pip uninstall pyrender scikit-robot-pyrender; pip install scikit-robot-pyrender",
        )  # fmt: skip
    for extra in PACKAGES:
        missing = missing_of(extra)
        if missing:
            command = f"pip install 'neural-sim[{extra}]' if you need it"
            yield Finding("note", f"extra {extra}", f"{', '.join(missing)} not installed", command)


def devices(accelerator: str) -> Iterator[Finding]:
    """Check the device that runs would use, the cores and the torch threads."""
    device = device_of(accelerator)
    if device.type == "cpu" and torch.cuda.is_available():
        yield Finding("note", "device", "this machine has a GPU, but runs use the CPU", "trainer=gpu")
    else:
        held = gpu(device)
        name = f"{held['device']}, {held['gpu_mb'] / 1024:.0f} GB" if "gpu_mb" in held else device.type
        yield Finding("ok", "device", name)
    cores, threads = len(os.sched_getaffinity(0)), torch.get_num_threads()
    advice = f"OMP_NUM_THREADS={cores}" if threads > cores else ""
    yield Finding("note" if advice else "ok", "cores", f"{cores} cores, {threads} torch threads", advice)


def opengl() -> Iterator[Finding]:
    """Check for an OpenGL backend that draws without a screen."""
    backend = opengl_platform()
    if backend is None:
        yield Finding(
            "note", "OpenGL", "neither EGL nor OSMesa works: meshes are drawn by ray casting, which is slower",
            "apt install libegl1 libgl1-mesa-dri, or libosmesa6",
        )  # fmt: skip
    else:
        yield Finding("ok", "OpenGL", f"draws with {backend}")


def database(uri: str) -> Iterator[Finding]:
    """Open the MLflow store, and close the runs that killed processes left open."""
    try:
        with quiet():
            client = connect(uri)
            closed = close_abandoned(client)
            count = len(client.search_experiments())
    except Exception as error:  # from MLflow, the database driver or the network
        yield Finding(
            "bad", "MLflow", f"{uri}: {first_line(error)}", "repair it, move it away, or set paths.mlflow"
        )
        return
    yield Finding("ok", "MLflow", f"{uri}: {count} experiments")
    if closed:
        yield Finding(
            "note", "MLflow", f"{len(closed)} runs of processes that have ended are now marked KILLED"
        )


def data(root: Path) -> Iterator[Finding]:
    """Check for the data-set folders that experiments refer to."""
    known: Sequence[str] = ("ycb", "ycb_video_sample", "ycb_in_the_wild", "objectnet", "captures")
    found = [name for name in known if (root / name).is_dir()]
    if found:
        yield Finding("ok", "data", f"{root}: {', '.join(found)}")
    else:
        advice = "only experiments on scans and photographs need data: set paths.data or NEURAL_SIM_DATA"
        yield Finding("note", "data", f"{root} has none of {', '.join(known)}", advice)


def _is_installed(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _free_memory_gb(root: Path = Path("/")) -> float | None:
    """Return the free memory, taking the limit of a container (cgroup v2) into account.

    The cache of files counts as free, because the kernel gives it up when programs need the memory.
    """
    group = root / "sys/fs/cgroup"
    try:
        free = 1024.0 * _number_in(root / "proc/meminfo", "MemAvailable:")
    except (OSError, StopIteration):
        return None
    try:
        used = int((group / "memory.current").read_text()) - _number_in(
            group / "memory.stat", "inactive_file"
        )
        free = min(free, int((group / "memory.max").read_text()) - used)
    except (OSError, ValueError, StopIteration):  # no cgroup, or "max"
        pass
    return free / 2**30


def _number_in(file: Path, name: str) -> int:
    """Return the number after ``name`` in a table of the kernel's."""
    rows = (row.split() for row in file.read_text().splitlines())
    return next(int(row[1]) for row in rows if row[0] == name)

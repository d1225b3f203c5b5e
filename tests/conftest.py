"""Small shared scenes, and where the real data lies."""

import gc
import os
import sys
from pathlib import Path
from typing import Any

import jaxtyping
import pytest
import shape_checking
from filelock import FileLock

shape_checking.install()  # before anything imports the package

import torch  # noqa: E402
from pretend_device import pretend_device, register  # noqa: E402

register()


def pytest_collection_finish():
    """Leave what was imported out of garbage collections: it lives as long as the process, and going through it took a
    third of the time of composing a configuration."""
    gc.collect()
    gc.freeze()


def pytest_unconfigure():
    gc.unfreeze()  # compiled modules complain of what is never collected


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder that holds ycb/ and ycb_video_sample/: ``NEURAL_SIM_DATA``, else ../shared beside the checkout."""
    root = Path(os.environ.get("NEURAL_SIM_DATA", Path(__file__).parents[2] / "shared"))
    if not (root / "ycb").is_dir():
        pytest.skip(f"no real data: {root / 'ycb'} does not exist (set NEURAL_SIM_DATA)")
    return root


@pytest.fixture(scope="session")
def paper_source() -> list[str]:
    """Lines of paper.tex, which lies beside the data."""
    root = Path(os.environ.get("NEURAL_SIM_DATA", Path(__file__).parents[2] / "shared"))
    if not (root / "paper.tex").is_file():
        pytest.skip(f"no source of the paper: {root / 'paper.tex'} does not exist (set NEURAL_SIM_DATA)")
    return (root / "paper.tex").read_text(encoding="utf-8").split("\n")


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def pretend():
    """``torch.device("pretend")`` and the ledger of its trips, see pretend_device.py."""
    with pretend_device() as ledger:
        yield ledger


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory) -> Path:
    """An MLflow store without runs, to be copied: its tables take ten seconds to make. Processes that share the tests
    share it, too."""
    from neural_sim.report.tracking import connect, tracking_uri

    own = tmp_path_factory.getbasetemp()
    path = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "empty" / "mlflow.db"
    with FileLock(path.parents[1] / "empty.lock"):
        if not path.exists():
            made = tmp_path_factory.mktemp("store") / "mlflow.db"
            connect(tracking_uri(str(made)))
            path.parent.mkdir()
            made.rename(path)
    return path


@pytest.fixture
def wrong_shapes():
    """Let arrays of wrong shapes through to the code's own checks, which are what the test is about."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def ray_cluster():
    """Three machines of one core each, all of them processes of this one, which ``workers=ray`` connects to."""
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    machine: dict[str, Any] = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))  # of the machines
        cluster = Cluster(initialize_head=True, head_node_args=machine)
        for _ in range(2):
            cluster.add_node(**machine)
        patched.setenv("RAY_ADDRESS", str(cluster.address))
        yield cluster
        ray.shutdown()
        cluster.shutdown()

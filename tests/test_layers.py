"""Packages import only from the packages before them, and each heavy library from its own place."""

import ast
from pathlib import Path

import neural_sim

PACKAGE = Path(neural_sim.__file__).parent
ORDER = (
    "types", "alpha", "checkpoint", "digests", "documents", "interruption", "processes", "randomness", "configuration",
    "extras", "workers", "commandline", "guide", "ranges", "declared", "cameras", "devices", "pictures", "masks",
    "objects", "field", "renderer", "parameter", "synthesis", "target", "detector", "solver", "gradient", "baseline",
    "outer", "report", "stages", "tasks", "studies", "main",
)  # fmt: skip
TORCH_ONLY = ("types", "cameras", "solver")


def _imports():
    for path in sorted(PACKAGE.rglob("*.py")):
        package = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                modules = [node.module or ""]
                if node.module == "neural_sim":
                    modules = [f"neural_sim.{alias.name}" for alias in node.names]
            else:
                continue
            for module in modules:
                yield path.relative_to(PACKAGE), package, module


def test_rooms_import_from_earlier_rooms_only():
    for path, package, module in _imports():
        if module.startswith("neural_sim.") and package != "__init__":
            other = module.split(".")[1]
            assert other in ORDER, f"{path} imports {module}, which has no place in the order"
            assert ORDER.index(other) <= ORDER.index(package), f"{path} imports {module}, a later package"


def test_heavy_libraries_stay_in_their_rooms():
    homes = {
        "pyrender": {"renderer/mesh.py"},
        "matplotlib": {"report", "studies"},
        "mlflow": {
            "report/tracking.py",
            "report/database.py",
            "report/model_files.py",
            "report/pyfunc_model.py",
        },
        "onnx": {"detector/onnx_export.py"},
        "onnxruntime": {"detector/onnx_export.py"},
        "safetensors": {"detector/saved_detector.py"},
        "jinja2": {"report/page/render.py"},
        "filelock": {"report/database.py", "stages/store.py"},
        "h5py": {"target/ycb_video.py"},
        "skimage": {"field/reconstruction.py"},
        "hydra": {"main.py"},
        "ray": {"workers.py"},
        "omegaconf": {"main.py"},
    }
    for path, package, module in _imports():
        top = module.split(".")[0]
        assert {str(path), package} & homes.get(top, {package}), f"{path} imports {module}"


def test_types_cameras_and_solvers_know_only_torch():
    standard = set(__import__("sys").stdlib_module_names)
    for path, package, module in _imports():
        top = module.split(".")[0]
        if package in TORCH_ONLY and top != "neural_sim":
            assert top in {"torch", "jaxtyping", "typing_extensions", "annotated_types"} | standard, (
                f"{path} imports {module}"
            )


def test_no_file_grows_over_400_lines():
    long = [p.name for p in PACKAGE.rglob("*.py") if len(p.read_text().splitlines()) > 400]
    assert not long


def test_pictures_are_opened_in_one_place():
    opening = [path for path in PACKAGE.rglob("*.py") if "Image.open(" in path.read_text()]
    assert opening == [PACKAGE / "pictures.py"]

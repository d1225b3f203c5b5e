"""Packages that only some inputs need: refused by name where they are missing, and not imported where nothing asks."""

import ast
import tomllib
from pathlib import Path

import pytest

from neural_sim import extras

ROOT = Path(__file__).parents[1]
DISTRIBUTIONS = {
    "skimage": "scikit-image",
    "hydra_plugins.hydra_joblib_launcher": "hydra-joblib-launcher",
    "hydra_plugins.hydra_submitit_launcher": "hydra-submitit-launcher",
}


@pytest.mark.parametrize("extra", extras.PACKAGES)
def test_what_is_missing_is_refused_with_the_command_that_installs_it(extra, monkeypatch):
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda name: None)
    names = ", ".join(extras.PACKAGES[extra])
    with pytest.raises(ValueError) as refusal:
        extras.require(extra, "objects.root")
    assert str(refusal.value) == f"objects.root: {names} not installed; pip install 'neural-sim[{extra}]'"


def test_extras_install_the_packages_that_they_are_asked_for():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert declared.keys() == extras.PACKAGES.keys()
    for extra, modules in extras.PACKAGES.items():
        installed = {requirement.partition(">")[0] for requirement in declared[extra]}
        assert installed == {DISTRIBUTIONS.get(name, name) for name in modules}


def test_modules_import_them_inside_of_functions_only():
    extra = {name for names in extras.PACKAGES.values() for name in names}
    for path in Path(extras.__file__).parent.rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            else:
                modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not extra & {module.partition(".")[0] for module in modules}, path

"""The version of a stage's code changes with every module that it imports, at any depth, and with no other."""

import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from neural_sim.stages.version import PACKAGE, ROOT, closure, code_version

STAGES = ("views", "field", "scene", "target_sets", "detector", "psi", "evaluate", "symmetry")


def package(folder: Path, files: dict[str, str]) -> Path:
    root = folder / "pack"
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


CHAIN = {
    "__init__.py": "",
    "a.py": "from pack.b import f\n",
    "b.py": "def f():\n    import pack.sub.c\n    return 1\n",
    "sub/__init__.py": "",
    "sub/c.py": "x = 1\n",
    "other.py": "from pack.a import f\n",
}


def test_the_closure_follows_imports_at_any_depth_and_inside_functions(tmp_path):
    root = package(tmp_path, CHAIN)
    assert closure(["pack.a"], root) == {"pack.a", "pack.b", "pack.sub.c"}


@pytest.mark.parametrize("touched", ["a.py", "b.py", "sub/c.py", "other.py"])
def test_only_what_is_imported_counts(tmp_path, touched):
    before = code_version(["pack.a"], package(tmp_path / "before", CHAIN))
    changed = {**CHAIN, touched: CHAIN[touched] + "y = 2\n"}
    after = code_version(["pack.a"], package(tmp_path / "after", changed))
    assert (before != after) == (touched != "other.py")


def test_prose_does_not_count(tmp_path):
    before = code_version(["pack.a"], package(tmp_path / "before", CHAIN))
    changed = {
        **CHAIN,
        "b.py": '"""What."""\n# why\n' + CHAIN["b.py"],
        "sub/c.py": CHAIN["sub/c.py"] + '"""What the constant means."""\n',
    }
    assert code_version(["pack.a"], package(tmp_path / "after", changed)) == before


SYNTAX = '''
async def f(a, /, b: int = 1, *c, d, e=None, **g):
    """What."""
    return lambda x: {**g, "y": f"{x!r:>{b}}"}


class A(list):
    @property
    def h(self):
        return [u"z", None, ..., 1j, *self]
'''


def test_the_version_is_equal_in_all_versions_of_python(tmp_path):
    """So stores can be shared: the digest below was the same in 3.11 and 3.13, whose ``ast.dump`` differ."""
    root = package(tmp_path, {"__init__.py": "", "a.py": SYNTAX})
    assert code_version(["pack.a"], root) == "7f7f9734c005"


@pytest.mark.parametrize(
    ("before", "after"), [("f()", "f([])"), ("x = None", "x = 0"), ("[x]", "x"), ("{**x}", "{1: x}")]
)
def test_what_a_file_means_counts(tmp_path, before, after):
    versions = [
        code_version(["pack.a"], package(tmp_path / name, {"__init__.py": "", "a.py": text}))
        for name, text in (("before", before), ("after", after))
    ]
    assert versions[0] != versions[1]


def test_a_plug_in_counts_by_its_own_source(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    versions = []
    for text in ("x = 1\n", "x = 22\n"):
        (tmp_path / "plugged_in.py").write_text(text)
        sys.modules.pop("plugged_in", None)
        importlib.invalidate_caches()
        importlib.import_module("plugged_in")
        versions.append(code_version(["plugged_in"]))
    assert versions[0] != versions[1]


@pytest.fixture(scope="module")
def modules():
    names = {
        path: ".".join(path.relative_to(ROOT.parent).with_suffix("").parts) for path in ROOT.rglob("*.py")
    }
    return {name.removesuffix(".__init__"): path for path, name in names.items()}


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """A copy of the package, whose files are parsed once for all stages."""
    made = tmp_path_factory.mktemp("copy") / PACKAGE
    return shutil.copytree(ROOT, made, ignore=shutil.ignore_patterns("__pycache__"))


@pytest.mark.parametrize("stage", STAGES)
def test_touching_any_module_that_a_stage_imports_changes_its_version_and_no_other_does(copy, stage, modules):
    """The modules that a stage imports are shared out among the stages, since each costs a version."""
    name = f"{PACKAGE}.stages.{stage}"
    imported = closure([name])
    before = code_version([name], copy)

    def version_with(*touched):
        before = {}
        for module in touched:
            place = copy / modules[module].relative_to(ROOT)
            before[place] = place.read_text(), place.stat()
            place.write_text(before[place][0] + "\n_TOUCHED = 1\n")
        version = code_version([name], copy)
        for place, (text, state) in before.items():
            place.write_text(text)
            os.utime(place, ns=(state.st_atime_ns, state.st_mtime_ns))
        return version

    assert version_with(*(module for module in modules if module not in imported)) == before
    for module in sorted(imported & modules.keys())[STAGES.index(stage) :: len(STAGES)]:
        assert version_with(module) != before, module
    assert version_with() == before


def test_all_that_importing_a_stage_loads_is_in_its_closure():
    """Of the stage that imports the least, and then of the one that imports the most, in one process."""
    names = [f"{PACKAGE}.stages.{stage}" for stage in ("views", "psi")]
    code = (
        f"import sys, importlib\nfor name in {names}:\n    importlib.import_module(name)\n"
        f"    print(*[m for m in sys.modules if m.split('.')[0] == '{PACKAGE}'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for name, line in zip(names, done.stdout.splitlines(), strict=True):
        loaded = set(line.split())
        packages = {
            m for m in loaded if (ROOT.parent / m.replace(".", "/")).is_dir()
        }  # empty but for a docstring
        assert len(loaded - packages) > 5 and loaded - packages <= closure([name])

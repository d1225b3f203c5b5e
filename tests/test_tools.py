"""Tools beside the package: their versions agree, and what they name exists."""

import re
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]


def test_hooks_run_the_versions_of_the_lock():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))["repos"]
    locked = dict(
        re.findall(r"^([\w-]+)==(\S+)$", (ROOT / "requirements.lock").read_text(encoding="utf-8"), re.M)
    )
    for name in ("ruff", "codespell"):
        (rev,) = (repo["rev"] for repo in hooks if any(hook["id"].startswith(name) for hook in repo["hooks"]))
        assert rev == f"v{locked[name]}"


def test_the_workflow_runs_the_projects_own_script():
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8"))
    steps = [step["run"] for step in workflow["jobs"]["check"]["steps"] if "run" in step]
    assert steps[-1] == ".ci/run" and (ROOT / ".ci/run").stat().st_mode & 0o111


def test_templates_are_forms_of_github():
    for form in (ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml"):
        told = yaml.safe_load(form.read_text(encoding="utf-8"))
        assert {"name", "description", "body"} <= told.keys()
        identities = [part["id"] for part in told["body"]]
        assert len(set(identities)) == len(identities)
        assert all(part["type"] == "textarea" and part["attributes"]["label"] for part in told["body"])

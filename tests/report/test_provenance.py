"""The commit of a checkout, against what git itself made; none where the code is not the checkout's."""

import subprocess

import pytest

from neural_sim.report.provenance import commit


@pytest.fixture
def package(tmp_path):
    """A package in a checkout of one commit."""
    folder = tmp_path / "checkout" / "package"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("a = 1\n")
    git(folder, "init", "--quiet")
    git(folder, "add", ".")
    author = ["-c", "user.name=A", "-c", "user.email=a@example.com", "-c", "commit.gpgsign=false"]
    git(folder, *author, "commit", "--quiet", "--message=One")
    return folder


def git(folder, *arguments):
    done = subprocess.run(["git", *arguments], cwd=folder, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def test_the_commit_of_a_checkout(package):
    git(package, "tag", "a-tag")
    assert commit(package) == git(package, "rev-parse", "--short=7", "HEAD")


def test_a_changed_checkout_is_dirty(package):
    (package / "__init__.py").write_text("a = 2\n")
    assert commit(package) == git(package, "rev-parse", "--short=7", "HEAD") + "-dirty"


def test_a_package_installed_in_another_project_has_no_commit_of_its(package):
    installed = package.parent / "site-packages" / "other"
    installed.mkdir(parents=True)
    (installed / "__init__.py").write_text("")
    assert commit(installed) is None


def test_outside_any_checkout_there_is_none(tmp_path):
    (tmp_path / "__init__.py").write_text("")
    assert commit(tmp_path) is None

"""Neural-Sim: learn which synthetic images to render, so that a detector trained on them does best on a target."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("neural-sim")
except PackageNotFoundError:
    __version__ = "not installed"

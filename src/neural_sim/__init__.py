"""Neural-Sim: learn which synthetic images to render, so that a detector trained on them does best on a target."""

__version__ = "0.1.0"

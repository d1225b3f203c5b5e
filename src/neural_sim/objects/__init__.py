"""Meshes: procedural, YCB layout, BOP models, any folder of meshes."""

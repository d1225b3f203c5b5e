"""Fit a field of a whole captured scene, and render masks of the object in it."""

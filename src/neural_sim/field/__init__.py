"""Radiance fields and their training."""

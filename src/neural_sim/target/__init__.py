"""Labelled target sets: what the detector shall be good at."""

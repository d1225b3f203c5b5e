"""Labelled target sets: where the detector will be used."""

"""Detectors (RetinaNet, FCOS, a classifier) as pure functions of a parameter dictionary; training, scores, files."""

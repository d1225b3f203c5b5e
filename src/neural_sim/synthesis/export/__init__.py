"""Data sets of drawn images in formats that other programs read."""

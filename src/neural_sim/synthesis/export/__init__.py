"""Data sets of drawn images in the formats that others read."""

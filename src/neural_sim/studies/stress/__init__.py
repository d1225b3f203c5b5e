"""Stiff and extreme cases, each checked with a tolerance from theory or against a float64 reference."""

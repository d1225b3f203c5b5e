"""Stiff and extreme cases, each held to a tolerance from theory or from a float64 reference."""

"""Stiff and extreme cases, each with a tolerance from theory or from a float64 reference."""

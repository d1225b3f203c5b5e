"""Distributions p_psi over scene parameters (paper, Tool 1)."""

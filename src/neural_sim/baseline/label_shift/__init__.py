"""Estimate psi from the target's labelled boxes by label shift, without training a detector."""

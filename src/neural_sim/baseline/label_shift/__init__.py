"""Estimate psi from the target's labelled boxes under label shift, without training a detector."""

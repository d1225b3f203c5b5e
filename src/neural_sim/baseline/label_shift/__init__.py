"""What the target shows: psi read off the target's boxes by label shift, without training a detector."""

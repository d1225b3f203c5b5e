"""Studies: what a run measures beyond learning psi; one file or package each, with settings, measurement and `run`."""

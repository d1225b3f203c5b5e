"""Linear solvers with a status, and the operators they act on."""

"""The psi loop: render, train, hypergradient, step (paper, Sec. 3)."""

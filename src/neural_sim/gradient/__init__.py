"""Hypergradients: adjoints (implicit, unrolled), and estimators of the derivative with respect to psi."""

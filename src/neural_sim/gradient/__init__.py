"""Hypergradients: adjoints (implicit, unrolled), and estimators of the derivative by psi."""

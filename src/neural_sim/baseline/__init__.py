"""Ways to choose psi that Neural-Sim is compared with."""

"""The methods that choose psi: Neural-Sim, and those with which it is compared."""

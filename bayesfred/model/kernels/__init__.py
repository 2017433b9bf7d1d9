"""Compiled loops over counts: log-likelihood, gradient, Fisher information, fluxes."""

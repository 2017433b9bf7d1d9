"""Compiled loops over counts: log-likelihood, gradient, Fisher information, profiled fluxes."""

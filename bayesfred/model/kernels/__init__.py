"""Compiled loops over counts: log-likelihood, its exact gradient, Fisher information, profiled fluxes."""

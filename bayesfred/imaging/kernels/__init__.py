"""Compiled loops of the forward model: arrays in, arrays out, no validation."""

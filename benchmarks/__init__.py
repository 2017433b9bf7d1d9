"""Ratios that say how fast the package is on this machine; `python -m benchmarks` prints them."""

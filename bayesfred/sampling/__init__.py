"""The draws: moves, ensembles, stopping, convergence, the chain and its file."""

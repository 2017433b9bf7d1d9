"""What the counts say: parameters, priors and likelihood of a frame, and its posterior."""

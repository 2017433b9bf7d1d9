"""What the counts say: a frame to draws from its posterior."""

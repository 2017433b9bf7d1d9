"""What the draws mean."""

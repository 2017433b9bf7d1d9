"""What a camera does: distortion coefficients to expected counts."""

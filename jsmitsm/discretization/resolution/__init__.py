"""What neighbours know of each other's coefficients and sources."""

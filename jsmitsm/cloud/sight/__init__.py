"""Which neighbours a particle sees."""

"""Gradients through a whole run."""

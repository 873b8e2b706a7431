"""Clouds of several regions: copies of a particle on both sides of an interface, and how such clouds are made."""

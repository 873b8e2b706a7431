"""Particles: shapes and how they are filled, neighbours, quadrature.

Imports runtime, taylor and particle.
"""

"""The particles and where they lie: shapes, filling, neighbours, integrals.

Imports runtime, taylor and particle.
"""

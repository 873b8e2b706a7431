"""Modes: eigenvalues and eigenfunctions of an operator, their errors and gradients.

From discretization it takes the pencil, from linear the factors, from solution the local polynomials.
"""

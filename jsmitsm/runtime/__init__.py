"""What JAX and the machine need: whole programs compiled once, threads, progress, errors.

Imports nothing of the package.
"""

"""One particle: its kernel, the recursion that its equation gives, its moment system.

Imports runtime and taylor.
"""

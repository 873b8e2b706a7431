"""Time: implicit steps on the pencil of an operator, factors kept, and gradients through whole runs.

From discretization it takes the pencil, from equation the record of the problem, from linear the factors; its states
are answers of solution.
"""

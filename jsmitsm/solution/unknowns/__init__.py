"""Solutions of problems that have more than equations and conditions: constraints, global unknowns, complex values."""

"""What a problem may have besides equations and conditions: constraints, global unknowns, complex values, sources."""

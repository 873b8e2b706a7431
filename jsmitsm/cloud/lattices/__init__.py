"""Particles in rows: intervals, boxes, and paths that follow a spacing however steeply it is graded."""

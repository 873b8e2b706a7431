"""Newton's method on the recursion, from a start to a solution, and along branches of solutions."""

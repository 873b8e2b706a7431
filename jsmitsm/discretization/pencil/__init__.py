"""The pencil of a linear operator: A u = B f + Bg g, the source f given by its values at the particles."""

"""Meshless solutions of boundary-value problems by local Taylor expansions, in JAX."""

from jsmitsm.clouds import Cloud, box, interval, rectangle
from jsmitsm.errors import SolveError
from jsmitsm.estimate import factorize
from jsmitsm.kernels import Constant, CubicSpline, Gaussian, Kernel, SuperGaussian, Wendland
from jsmitsm.neighbours import Stencils, stencils
from jsmitsm.operators import divergence, grad, hessian, laplacian, partial
from jsmitsm.problem import Problem, condition, dirichlet, fix, free, neumann, periodic, robin
from jsmitsm.shapes import from_polygon, from_sdf
from jsmitsm.solution import Solution
from jsmitsm.solve import solve
from jsmitsm.taylor import multi_indices

__version__ = "0.1.0"

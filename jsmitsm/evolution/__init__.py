"""A problem in time: one pencil for space, implicit steps with kept factors, gradients through a whole run."""

"""What space makes of a problem in time: its parts, its pencil on the free values, fits of states."""

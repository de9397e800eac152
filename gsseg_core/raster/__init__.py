"""A posed view as a linear operator: render and adjoint, on the CPU and on a GPU."""

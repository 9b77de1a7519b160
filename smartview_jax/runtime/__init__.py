"""Run the numerical code: compile, keep programs, pad shapes, limit threads, end on Ctrl-C."""

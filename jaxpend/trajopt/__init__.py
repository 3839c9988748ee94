"""Trajectory optimisation: iLQR, the swing-up problem, the search, and reference trajectories."""

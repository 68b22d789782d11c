"""Plots to fused tracks: local tracks of each sensor, system tracks of all, and the test that joins them."""

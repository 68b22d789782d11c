"""Simulated worlds: truth, sensors, recordings, scores and pictures."""

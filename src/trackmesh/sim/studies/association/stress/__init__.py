"""Tests of association on the tracks of two simulated radars, in cases of growing difficulty."""

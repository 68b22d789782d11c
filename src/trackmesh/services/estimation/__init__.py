"""Pure numerics of tracking: arrays in, arrays out. No I/O, no clock, no logging, no messages.

State order is [east_m, north_m, veast, vnorth] everywhere; leading axis tracks, then models, then state.
"""

"""The EMI service: batches of scans asked over the network, inverted by worker processes, answered scan by scan."""

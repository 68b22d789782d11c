"""The services, one room each; ``estimation`` is the numerics they share, ``runtime`` what their processes share."""

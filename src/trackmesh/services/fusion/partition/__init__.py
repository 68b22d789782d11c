"""Several fusion units in one realm, each with an area of its own: who keeps which plots, and who owns which track."""

"""A deployment from one file: who takes part and may do what, as certificates and as the settings of its routers."""

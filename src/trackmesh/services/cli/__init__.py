"""The command ``trackmesh``: everything a person can start, watch, ask or convert."""

"""The study of track-to-track association: a paper's tables anew, and the same methods under stress."""

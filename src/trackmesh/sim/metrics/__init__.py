"""How far a set of tracks is from a set of targets, at one time and over a whole run.

Positions are (n, 2) metres in one plane. Targets come first, tracks second, in every argument list. Pure functions on
arrays; each module names its sources.
"""

from trackmesh.sim.metrics.accuracy import mean, nees, nees_band, rmse
from trackmesh.sim.metrics.identity import Pairs, continuity, identity_switches, lasting, purity
from trackmesh.sim.metrics.matching import Gospa, Match, gospa, match, ospa
from trackmesh.sim.metrics.nearest import nearest_distance, nearest_target, tracked_once
from trackmesh.sim.metrics.segments import Cover, Segments, covered_s, fewest_changes, segments
from trackmesh.sim.metrics.siap import Siap, SiapCount, siap, siap_count
from trackmesh.sim.metrics.switching import UNASSIGNED, Followers, Switches, gospa_with_switching

__all__ = [
    "UNASSIGNED",
    "Cover",
    "Followers",
    "Gospa",
    "Match",
    "Pairs",
    "Segments",
    "Siap",
    "SiapCount",
    "Switches",
    "continuity",
    "covered_s",
    "fewest_changes",
    "gospa",
    "gospa_with_switching",
    "identity_switches",
    "lasting",
    "match",
    "mean",
    "nearest_distance",
    "nearest_target",
    "nees",
    "nees_band",
    "ospa",
    "purity",
    "rmse",
    "segments",
    "siap",
    "siap_count",
    "tracked_once",
]

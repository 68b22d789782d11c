"""What a fit is worth: detection, goodness of fit, covariance, shape, attitude, and one verdict a scan.

Functions on stacks have the scans of a chunk as their leading axis b. Each scan's answer is the same bits whatever
stands beside it.
"""

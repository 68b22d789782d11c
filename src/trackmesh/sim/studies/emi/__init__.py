"""The induction thesis anew: its tables and figures beside ours, and how near each estimator comes to the bound."""

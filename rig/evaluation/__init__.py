"""The evaluations of `rig eval`: in several processes, resumable, with results as page, table, figures and JSON."""
